"""``python -m diffatmo`` is the ``diffatmo`` command."""

import sys

from diffatmo.cli.main import main

sys.exit(main())
