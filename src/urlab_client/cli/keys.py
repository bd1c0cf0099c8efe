"""`urlab keys`: CURVE keys for servers that are open to a network, and for their clients.

Make and show CURVE keys. A server that is open to a network needs a key pair, by which clients recognise it, and the
public key of each client that it admits.
"""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from urlab_client.cli._arguments import Parser
from urlab_client.keys import SECRET_SUFFIX, KeyPair, public_key

EXAMPLES = (
    ("urlab keys new server ada", "make keys for a server and for a client called ada"),
    ("urlab keys show server.key", "print a public key"),
)


def add_arguments(parser: Parser) -> None:
    """Add the options."""
    actions = parser.add_subparsers(title="actions", dest="action", metavar="ACTION", required=True)
    new = actions.add_parser(
        "new",
        help="make key pairs",
        description="Make key pairs: NAME.key, which you can give to anyone, and NAME.key_secret, which only its owner "
        "can read (mode 0600) and which stays on this machine. Existing files are never overwritten.",
        examples=[("urlab keys new server", "server.key and server.key_secret in this folder")],
    )
    new.add_argument("names", nargs="+", metavar="NAME", help="for example server, or the name of a client")
    new.add_argument("--dir", type=Path, default=Path(), metavar="DIR", help="where to write (default: here)")
    show = actions.add_parser(
        "show",
        help="print public keys",
        description="Print the public key of each file.",
        examples=[("urlab keys show server.key", "its public key and kind")],
    )
    show.add_argument("files", nargs="+", type=Path, metavar="FILE", help="a .key or .key_secret file")


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
