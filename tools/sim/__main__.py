"""``python -m tools.sim``."""

import sys

from tools.sim.run import main

sys.exit(main())
