"""`python -m planish` is the command `planish`."""

import sys

from ._command import main

sys.exit(main())
