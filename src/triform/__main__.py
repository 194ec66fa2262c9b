"""``python -m triform`` runs the command line."""

import sys

from triform.cli import main

if __name__ == "__main__":
    sys.exit(main())
