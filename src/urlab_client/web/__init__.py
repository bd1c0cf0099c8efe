"""The console in the browser, and the HTTP and WebSocket API under it: a Starlette application on the async client.

Needs the `web` extra: `pip install 'urlab-client[web]'`.
"""

try:
    import PIL
    import starlette
except ImportError as error:
    raise ImportError(f"urlab_client.web needs {error.name}: pip install 'urlab-client[web]'") from error

from urlab_client.web.access import Access
from urlab_client.web.application import app

__all__ = ["Access", "app"]

del PIL, starlette
