"""``python -m tests.faults [WORDS...]``: play the cells that have all words in their name, keep what was measured, and
write docs/faults.md from it. Without words all of them are played (six minutes of one core); ``--render`` plays none.
"""

from __future__ import annotations

import argparse
import sys

from tests.faults.matrix import cells, objections, play
from tests.faults.report import PAGE, keep, kept, measured, page


def main() -> int:
    """Play, keep, write; 1 where a cell without a known defect was not survived, or one with a defect was."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument("words", nargs="*", help="lidar, adc, odometry; off, stuck...; start, run, stop")
    parser.add_argument("--render", action="store_true", help="only write the page from what was measured before")
    options = parser.parse_args()
    surprises = 0
    for cell in () if options.render else cells():
        if set(options.words) <= set(cell.name.split()):
            out = play(cell)
            said = objections(cell, out)
            keep({cell.name: measured(cell, out, said)})
            surprises += bool(said) != bool(cell.defect)
            sys.stdout.write(f"{cell.name}: {'; '.join(said) or 'survived'}\n")
            sys.stdout.flush()
    PAGE.write_text(page(kept()))
    return 1 if surprises else 0


if __name__ == "__main__":
    sys.exit(main())
