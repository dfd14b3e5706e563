"""`python -m gen2d`."""

import sys

from gen2d.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
