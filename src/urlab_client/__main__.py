"""`python -m urlab_client` is the `urlab` command."""

import sys

from urlab_client.cli import main

if __name__ == "__main__":
    sys.exit(main())
