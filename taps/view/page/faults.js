// The list of faults: causes with their remedies; what follows from a cause is folded below it.

import { $, element, marked } from "./panel.js";

const MOST = 3;          // causes shown at first, the most severe ones

// The faults as [cause, its consequences], in the published order. A chain of causes ends at its first.
export function grouped(faults) {
  const by = new Map(faults.map((one) => [one.fault, one]));
  const root = (one) => {
    const passed = new Set();
    while (one.cause && by.has(one.cause) && !passed.has(one.fault)) { passed.add(one.fault); one = by.get(one.cause); }
    return one;
  };
  const groups = new Map();
  for (const one of faults) {
    const first = root(one);
    if (!groups.has(first)) groups.set(first, []);
    if (first !== one) groups.get(first).push(one);
  }
  return [...groups];
}

export class FaultList {
  constructor() { this.open = new Set(); }

  show(faults) {
    const key = JSON.stringify(faults);
    if (this.shown === key) return;
    this.shown = key;
    const items = grouped(faults).map(([cause, rest]) => this.group(cause, rest));
    const more = items.splice(MOST);
    if (more.length) items.push(this.fold("more", `${more.length} more`, more));
    $("faults").replaceChildren(...items);
  }

  group(cause, rest) {
    const item = line(cause);
    item.append(remedy(cause));
    if (rest.length) item.append(this.fold(String(cause.fault), rest.length > 1 ? `${rest.length} consequences` : "1 consequence", rest.map(line)));
    return item;
  }

  // A folded list, which stays open where the user has opened it.
  fold(name, title, items) {
    const made = element("details"), list = element("ul", "faults");
    made.open = this.open.has(name);
    made.addEventListener("toggle", () => { if (made.open) this.open.add(name); else this.open.delete(name); });
    list.append(...items);
    made.append(element("summary", "", title), list);
    return made;
  }
}

function line({ fault, meaning }) {
  const item = element("li");
  item.append(element("b", "", `${fault} `), ...marked(meaning));
  return item;
}

function remedy({ remedy: text }) {
  const made = element("span", "remedy");
  made.append(...marked(text));
  return made;
}
