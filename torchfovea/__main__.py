"""``python -m torchfovea``."""

import sys

from torchfovea.cli import main

if __name__ == "__main__":
    sys.exit(main())
