"""CURVE key files, which identify servers and the clients that may connect to them.

Client, server and command line use this module. A key pair is two files in the format of ZeroMQ's certificates:
`NAME.key` contains the public key and may be shared, `NAME.key_secret` contains both keys and stays where it was
created. The representations of objects show only public keys.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from urlab_client.errors import URLabError

__all__ = ["PUBLIC_SUFFIX", "SECRET_SUFFIX", "KeyFileError", "KeyPair", "public_key", "public_keys", "read_pair"]

PUBLIC_SUFFIX: Final = ".key"
SECRET_SUFFIX: Final = ".key_secret"  # noqa: S105 - of a file name

_Z85: Final = frozenset("0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ.-:+=^!/*?&<>()[]{}@%$#")
_LENGTH: Final = 40
_MAX_BYTES: Final = 64 * 1024
_HEADER: Final = "#   CURVE {kind} key of '{name}'. {advice}\n\nmetadata\n    name = \"{name}\"\ncurve\n"


class KeyFileError(URLabError, ValueError):
    """A key file is missing, is not a key file, or is readable by other users."""


@dataclass(frozen=True)
class KeyPair:
    """A CURVE key pair.

    Attributes:
        public: Public key, Z85 text of 40 characters.
        secret: Secret key, Z85 text of 40 characters; not part of the representation.
    """

    public: bytes
    secret: bytes = field(repr=False)

    @staticmethod
    def new() -> KeyPair:
        """Generate a new key pair."""
        import zmq  # importing the package opens nothing

        return KeyPair(*zmq.curve_keypair())

    def write(self, folder: Path, name: str) -> tuple[Path, Path]:
        """Write `NAME.key` and `NAME.key_secret`, the latter readable by its owner only.

        Returns:
            The public file and the secret file.

        Raises:
            KeyFileError: The name is not a valid file name, or one of the files exists: keys are never overwritten.
            OSError: A file cannot be written.
        """
        if not name or name.startswith(".") or not all(char.isalnum() or char in "-_." for char in name):
            raise KeyFileError(f"{name!r} is not a valid key name: use letters, digits, '-', '_' and '.'")
        files = folder / f"{name}{PUBLIC_SUFFIX}", folder / f"{name}{SECRET_SUFFIX}"
        for file in files:
            if file.exists():
                raise KeyFileError(f"{file} exists, and keys are never overwritten.", hint="Choose another name.")
        folder.mkdir(parents=True, exist_ok=True)
        public = f'    public-key = "{self.public.decode()}"\n'
        secret = f'{public}    secret-key = "{self.secret.decode()}"\n'
        header = {"kind": "secret", "name": name, "advice": "Keep it to yourself."}
        _create(files[1], _HEADER.format(**header) + secret, 0o600)
        header |= {"kind": "public", "advice": "May be given to anybody."}
        _create(files[0], _HEADER.format(**header) + public, 0o644)
        return files


def read_pair(file: str | os.PathLike[str]) -> KeyPair:
    """Read a secret key file.

    Raises:
        KeyFileError: The file cannot be read, contains no secret key, or is readable by other users.
    """
    path = Path(file)
    public, secret = _read(path)
    if secret is None:
        raise KeyFileError(f"{path} contains no secret key.", hint=f"Name the file that ends in {SECRET_SUFFIX}.")
    if os.name == "posix" and path.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise KeyFileError(f"{path} contains a secret key and is open to other users.", hint=f"Run chmod 600 {path}")
    return KeyPair(public, secret)


def public_key(source: str | os.PathLike[str]) -> bytes:
    """Return a public key, given as its 40 characters or as a key file.

    Raises:
        KeyFileError: `source` is neither a key nor a key file.
    """
    text = os.fspath(source)
    if len(text) == _LENGTH and _Z85.issuperset(text) and not Path(text).exists():
        return text.encode()
    return _read(Path(text))[0]


def public_keys(sources: Iterable[str | os.PathLike[str]]) -> frozenset[bytes]:
    """Return the public keys of files, and of all `*.key` files in folders.

    Raises:
        KeyFileError: A file is not a key file, or a folder contains none.
    """
    found: set[bytes] = set()
    for source in map(Path, sources):
        if not source.is_dir():
            found.add(public_key(source))
            continue
        files = sorted(source.glob(f"*{PUBLIC_SUFFIX}"))
        if not files:
            raise KeyFileError(f"{source} contains no file that ends in {PUBLIC_SUFFIX}.")
        found.update(map(public_key, files))
    return frozenset(found)


def _create(file: Path, text: str, mode: int) -> None:
    # zmq.auth.create_certificates overwrites keys, and writes the secret one with the process's default permissions.
    handle = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    with os.fdopen(handle, "w", encoding="ascii", errors="replace") as stream:
        stream.write(text)


def _read(path: Path) -> tuple[bytes, bytes | None]:
    # zmq.auth.load_certificate returns any text as a key, and raises IndexError for half a line.
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise KeyFileError(f"{path} is not a key file: it is too long.")
        lines = path.read_text("utf-8").splitlines()
    except OSError as error:
        raise KeyFileError(f"{path}: the key cannot be read: {error.strerror or error}.") from None
    except UnicodeDecodeError:
        raise KeyFileError(f"{path} is not a key file.", hint="Create key files with `urlab keys new`.") from None
    entries = {name.strip(): value.strip().strip('"') for name, _, value in (line.partition("=") for line in lines)}
    public, secret = entries.get("public-key"), entries.get("secret-key")
    for key in (public, secret) if secret is not None else (public,):
        if key is None or len(key) != _LENGTH or not _Z85.issuperset(key):
            # The text is not shown: it may be most of a secret.
            raise KeyFileError(f"{path} is not a key file.", hint="Create key files with `urlab keys new`.")
    return str(public).encode(), None if secret is None else secret.encode()
