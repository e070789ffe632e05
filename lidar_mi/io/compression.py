"""Compressed files: their first bytes, and the program that unpacks them."""

_PROGRAMS = (
    (b"\x1f\x8b", "gzip", "gunzip"),
    (b"BZh", "bzip2", "bunzip2"),
    (b"\xfd7zXZ\0", "xz", "unxz"),
    (b"\x28\xb5\x2f\xfd", "zstd", "zstd -d"),
)


def compression(start: bytes) -> tuple[str, str] | None:
    """Name and program of the compression, by the first bytes of a file; None: not compressed."""
    for mark, name, program in _PROGRAMS:
        if start.startswith(mark):
            return name, program
    return None
