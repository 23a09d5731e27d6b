"""A simulated robot, its daemon and a page of it as processes; Debian's chromium, driven over its own protocol."""

import argparse
import asyncio
import base64
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from aiohttp import ClientSession, ClientWebSocketResponse

from daemon.publish.modbus.client import Reader
from tools.demo.run import Patience, running, simulator_words, wait_for_pose, wait_for_simulator, write_config
from tools.sim.ports import free_port

ROOT = Path(__file__).parents[2]
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


class BrowserError(RuntimeError):
    """A process or a page does not do what it should; the text says what."""


class PageLeft(BrowserError):
    """The page was asked while it is being left for another one."""


LEFT: Final = ("navigated or closed", "context was destroyed", "Cannot find default execution context")
"""What the browser says then."""


@dataclass(frozen=True)
class Robot:
    """A daemon that follows a simulated robot. `config` names it; `env` leads to its stream; `port`: Modbus."""

    folder: Path
    config: Path
    env: dict[str, str]
    port: int
    daemon: subprocess.Popen[str]
    simulator: subprocess.Popen[str]

    def drive(self) -> None:
        """Let it go."""
        self.simulator.send_signal(signal.SIGUSR1)


@contextlib.contextmanager
def robot(folder: Path, seed: int = 0) -> Iterator[Robot]:
    """A simulated one in the paper's room, with its daemon, which has a pose."""
    modbus, odometry = free_port(), free_port()
    config = write_config(folder, modbus, odometry)
    env = {**os.environ, "XDG_RUNTIME_DIR": str(folder)}
    options = argparse.Namespace(building="paper_room", seed=seed, dark=False)
    words = [sys.executable, "-m", "daemon", "run", "--config", str(config)]
    with contextlib.ExitStack() as stack:
        sim_words = simulator_words(options, folder, odometry, free_port())
        log = folder / "simulator.log"
        simulator = stack.enter_context(running(sim_words, log, stdout=subprocess.PIPE))
        wait_for_simulator(simulator, Patience(folder))
        daemon = stack.enter_context(running(words, folder / "daemon.log", stdout=subprocess.DEVNULL, env=env))
        reader = stack.enter_context(Reader("127.0.0.1", modbus))
        wait_for_pose(daemon, reader, Patience(folder))
        yield Robot(folder, config, env, modbus, daemon, simulator)


@contextlib.contextmanager
def view(env: dict[str, str], folder: Path, *words: str) -> Iterator[str]:
    """The page's address, as `lumiloop view` prints it."""
    log = folder / "view.log"
    command = [sys.executable, "-m", "daemon", "view", "--port", "0", *words]
    with running(command, log, stdout=subprocess.DEVNULL, env=env) as child:
        end = time.monotonic() + 60.0
        while "http://" not in (told := log.read_text()):
            if child.poll() is not None or time.monotonic() > end:
                raise BrowserError(f"the page is not served: {told}")
            time.sleep(0.05)
        yield "http://" + told.partition("http://")[2].split()[0]


AIM: Final = """(selector) => {
  const wanted = document.querySelector(selector);
  const kinds = ["pointerdown", "mousedown", "pointerup", "mouseup", "click"];
  let hit = false;
  const guard = (event) => {
    if (!wanted.contains(event.target)) event.stopImmediatePropagation();
    else if (event.type === "click") hit = true;
  };
  for (const kind of kinds) addEventListener(kind, guard, true);
  globalThis.aim_ended = () => { for (const kind of kinds) removeEventListener(kind, guard, true); return hit; };
  wanted.scrollIntoView({ block: "center" });
  const box = wanted.getBoundingClientRect();
  return [box.x + box.width / 2, box.y + box.height / 2];
}"""
"""The middle of an element; what is pressed beside it is kept from the page until ``aim_ended``."""


@dataclass
class Tab:
    """One page in a browser. said: errors and warnings of it."""

    socket: ClientWebSocketResponse
    number: int = 0
    said: list[str] = field(default_factory=list)

    async def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The answer of the browser to a method of its protocol."""
        self.number += 1
        number = self.number
        await self.socket.send_json({"id": number, "method": method, "params": parameters})
        while True:
            message = await self.socket.receive_json()
            if message.get("id") == number:
                if "error" in message:
                    left = any(words in message["error"].get("message", "") for words in LEFT)
                    raise (PageLeft if left else BrowserError)(f"{method}: {message}")
                return dict(message["result"])
            self._note(message)

    async def js(self, expression: str) -> Any:
        """The value of an expression in the page."""
        told = await self.ask("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in told:
            raise BrowserError(f"{expression}: {told}")
        return told["result"].get("value")

    async def until(self, expression: str, seconds: float = 20.0) -> None:
        """Until an expression is true in the page, or in the one that is loaded in its place meanwhile.

        Raises:
            BrowserError: it does not become so.
        """
        end = asyncio.get_running_loop().time() + seconds
        while not await self._is(expression):
            if asyncio.get_running_loop().time() > end:
                raise BrowserError(f"it does not happen that {expression}; {self.said}")
            await asyncio.sleep(0.1)

    async def _is(self, expression: str) -> bool:
        try:
            return bool(await self.js(f"!!({expression})"))
        except PageLeft:
            return False

    async def click(self, selector: str) -> None:
        """As a finger would: in the middle of an element, again where the page has moved away beneath the finger.

        Raises:
            BrowserError: the element cannot be hit.
        """
        await self.ask("Page.bringToFront")
        for _ in range(5):
            await self.drag([tuple(await self.js(f"({AIM})({json.dumps(selector)})"))])
            if await self.js("globalThis.aim_ended()"):
                return
        raise BrowserError(f"{selector} cannot be hit")

    async def drag(self, way: list[tuple[float, float]]) -> None:
        """Press, move along, let go; in pixels of the view."""
        for kind, (x, y) in [
            ("mousePressed", way[0]),
            *(("mouseMoved", at) for at in way[1:]),
            ("mouseReleased", way[-1]),
        ]:
            await self.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    async def picture(self, path: Path) -> None:
        """What is seen, as PNG."""
        told = await self.ask("Page.captureScreenshot", format="png")
        await asyncio.to_thread(path.write_bytes, base64.b64decode(told["data"]))

    def _note(self, message: dict[str, Any]) -> None:
        parameters = message.get("params", {})
        if message.get("method") == "Runtime.exceptionThrown":
            self.said.append(json.dumps(parameters["exceptionDetails"])[:500])
        elif message.get("method") == "Runtime.consoleAPICalled" and parameters["type"] in ("error", "warning"):
            self.said.append(json.dumps(parameters["args"])[:500])
        elif message.get("method") == "Log.entryAdded" and parameters["entry"]["level"] in ("error", "warning"):
            self.said.append(json.dumps(parameters["entry"])[:500])


@contextlib.contextmanager
def chromium(folder: Path) -> Iterator[str]:
    """A headless browser; the address of its DevTools."""
    if CHROMIUM is None:
        raise BrowserError("no chromium: apt-get install chromium")
    profile = folder / "chromium"
    words = [CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run"]
    words += ["--disable-background-networking", "--disable-component-update", "--remote-debugging-port=0"]
    words += [f"--user-data-dir={profile}", "--remote-allow-origins=*", "about:blank"]
    with running(words, folder / "chromium.log", stdout=subprocess.DEVNULL) as child:
        port = profile / "DevToolsActivePort"
        end = time.monotonic() + 60.0
        while not (port.exists() and port.read_text().strip()):
            if child.poll() is not None or time.monotonic() > end:
                raise BrowserError(f"the browser does not start: {(folder / 'chromium.log').read_text()}")
            time.sleep(0.05)
        yield f"http://127.0.0.1:{port.read_text().split()[0]}"


@contextlib.asynccontextmanager
async def tab(
    browser: str, address: str, size: tuple[int, int] = (1280, 800), phone: bool = False, dark: bool = True
) -> AsyncIterator[Tab]:
    """A page in a tab of its own."""
    request = urllib.request.Request(f"{browser}/json/new?about:blank", method="PUT")
    told = json.loads(await asyncio.to_thread(lambda: urllib.request.urlopen(request).read()))
    async with ClientSession() as session, session.ws_connect(told["webSocketDebuggerUrl"], max_msg_size=1 << 26) as ws:
        page = Tab(ws)
        for domain in ("Page", "Runtime", "Log", "Network"):
            await page.ask(f"{domain}.enable")
        scale = 2 if phone else 1
        await page.ask(
            "Emulation.setDeviceMetricsOverride",
            width=size[0], height=size[1], deviceScaleFactor=scale, mobile=phone,
        )  # fmt: skip
        feature = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        await page.ask("Emulation.setEmulatedMedia", features=[feature])
        await page.ask("Page.navigate", url=address)
        yield page
        await asyncio.to_thread(lambda: urllib.request.urlopen(f"{browser}/json/close/{told['id']}").read())
