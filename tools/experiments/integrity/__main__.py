"""``python -m tools.experiments.integrity``."""

import sys

from tools.experiments.integrity.campaign import main

if __name__ == "__main__":
    sys.exit(main())
