"""`python -m torchsph`."""

import sys

from torchsph.cli import main

if __name__ == "__main__":
    sys.exit(main())
