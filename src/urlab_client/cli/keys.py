"""`urlab keys`: CURVE keys for servers that are open to a network, and for their clients.

Make and show CURVE keys. A server that is open to a network needs a key pair, by which clients recognise it, and the
public key of each client that it admits.
"""

from __future__ import annotations

from argparse import Namespace

from urlab_client.cli._arguments import Parser, add_usage
from urlab_client.keys import SECRET_SUFFIX, KeyPair, public_key

USAGE = """
examples:
urlab keys new server ada  make keys for a server and for a client called ada
urlab keys show server.key  print a public key
"""

_NEW = """
NAME+  for example server, or the name of a client
--dir DIR=.  where to write (default: here)
examples:
urlab keys new server  server.key and server.key_secret in this folder
"""
_SHOW = """
FILE+  a .key or .key_secret file
examples:
urlab keys show server.key  its public key and kind
"""


def add_actions(parser: Parser) -> None:
    """Add the actions, each with its own arguments."""
    actions = parser.add_subparsers(title="actions", dest="action", metavar="ACTION", required=True)
    about_new = (
        "Make key pairs: NAME.key, which you can give to anyone, and NAME.key_secret, which only its owner can read "
        "(mode 0600) and which stays on this machine. Existing files are never overwritten."
    )
    add_usage(actions.add_parser("new", help="make key pairs", description=about_new), _NEW)
    about_show = "Print the public key of each file."
    add_usage(actions.add_parser("show", help="print public keys", description=about_show), _SHOW)


def run(arguments: Namespace) -> int:
    """Make or show keys."""
    if arguments.action == "new":
        for name in arguments.names:
            public, secret = KeyPair.new().write(arguments.dir, name)
            print(f"{public}: to give away\n{secret}: to keep")
    else:
        for file in arguments.files:
            kind = "secret" if file.suffix == SECRET_SUFFIX else "public"
            print(f"{public_key(file).decode()}  {file} ({kind} key file)")
    return 0
