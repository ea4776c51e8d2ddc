"""Plain texts for file errors."""

import errno

_WORDS = {
    errno.ENOENT: "there is no such file or folder",
    errno.EISDIR: "is a folder; a file is needed",
    errno.ENOTDIR: "a part of this path is a file; a folder is needed",
    errno.EEXIST: "already exists and is not a folder",
    errno.EACCES: "this user may not read or write it",
    errno.EPERM: "this user may not read or write it",
    errno.EROFS: "is on a read-only disk",
    errno.ENOSPC: "the disk is full",
    errno.ENAMETOOLONG: "the name is too long",
}


def in_words(error: OSError) -> str:
    """Text of an error, without the file's name; the system's text if there is none here."""
    return _WORDS.get(error.errno or 0) or error.strerror or str(error)


def is_known(error: OSError) -> bool:
    """Whether the error has a text here."""
    return error.errno in _WORDS
