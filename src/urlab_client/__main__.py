"""`python -m urlab_client` is the `urlab` command."""

import gc
import sys

# Every `sim://` server starts here. Importing MuJoCo and the server allocates so much that Python's default of 700
# would look for garbage many times, where there is none: a tenth of the time of the imports.
gc.set_threshold(10_000)

from urlab_client.cli import main  # noqa: E402  # not before

if __name__ == "__main__":
    sys.exit(main())
