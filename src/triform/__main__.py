"""``python -m triform`` runs the command line."""

import sys

from triform.cli import main

sys.exit(main())
