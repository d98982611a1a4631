"""``python -m varpin`` is the ``varpin`` command."""

import sys

from varpin.cli import main

sys.exit(main())
