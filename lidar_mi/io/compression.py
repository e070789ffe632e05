"""Files that are compressed as a whole: how they begin, and which program undoes it."""

_PROGRAMS = (
    (b"\x1f\x8b", "gzip", "gunzip"),
    (b"BZh", "bzip2", "bunzip2"),
    (b"\xfd7zXZ\0", "xz", "unxz"),
    (b"\x28\xb5\x2f\xfd", "zstd", "zstd -d"),
)


def compression(start: bytes) -> tuple[str, str] | None:
    """Name of the compression of a file that begins so, and the program; None if there is none."""
    for mark, name, program in _PROGRAMS:
        if start.startswith(mark):
            return name, program
    return None
