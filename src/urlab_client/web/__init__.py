"""The console in the browser, and the HTTP and WebSocket API under it: a Starlette application on the async client.

Needs the extra `web`.
"""

from urlab_client._installation import need

need("PIL", "starlette", extra="web")

from urlab_client.web.access import Access  # noqa: E402 - its libraries may be missing
from urlab_client.web.application import app, apps  # noqa: E402

__all__ = ["Access", "app", "apps"]
