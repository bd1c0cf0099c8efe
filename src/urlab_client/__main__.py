"""`python -m urlab_client` is the `urlab` command."""

import gc
import sys

# Every `sim://` server starts here. Importing MuJoCo and the server allocates so many objects that, with the default
# threshold of 700, Python would collect garbage many times and find none. That takes a tenth of the import time.
gc.set_threshold(10_000)

from urlab_client.cli import main  # noqa: E402  # after the line above

if __name__ == "__main__":
    sys.exit(main())
