"""The console in the browser, and the HTTP and WebSocket API under it: a Starlette application on the async client.

Needs the extra `web`.
"""

try:
    import PIL
    import starlette
except ImportError as error:
    from urlab_client._installation import install_command

    raise ImportError(
        f"urlab_client.web: {error.name} is not installed; run: {install_command('web')}", name=error.name
    ) from error

from urlab_client.web.access import Access
from urlab_client.web.application import app, apps

__all__ = ["Access", "app", "apps"]

del PIL, starlette
