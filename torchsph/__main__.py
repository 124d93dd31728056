"""`python -m torchsph`."""

import sys

from torchsph.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
