"""The console command: `python -m jaxsimp`, the same as `jaxsimp`."""

import sys

from jaxsimp.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
