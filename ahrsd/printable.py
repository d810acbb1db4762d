"""Text where a person sees it: foreign text made printable, and counts in English.

Foreign text gets no control characters, and is not longer than it may be.
"""

from __future__ import annotations

NAME = 64  # characters of a name
LINE = 2000  # characters of a whole line


def printable(text: object, longest: int = NAME) -> str:
    r"""The text as one line of at most `longest` characters.

    Whatever a terminal would obey or could not show (escapes, new lines, directions of writing,
    bytes of a file name that are no text) becomes its escape, for example \x1b or \n.
    """
    words = str(text)
    if len(words) > longest:  # before anything looks at each character
        words = f"{words[: longest - 3]}..."
    if words.isprintable():
        return words
    return "".join(char if char.isprintable() else _escape(char) for char in words)


def line(text: object) -> str:
    """The same for a whole line."""
    return printable(text, LINE)


def drawn(text: object, longest: int = NAME) -> str:
    """The same for a picture, where a dollar sign would begin a formula."""
    return printable(text, longest).replace("$", r"\$")


def _escape(char: str) -> str:
    code = ord(char)
    if 0xDC80 <= code <= 0xDCFF:  # how Python holds a byte of a name that is no text
        return f"\\x{code - 0xDC00:02x}"
    if code < 0x100:
        return char.encode("unicode_escape").decode()
    return f"\\u{code:04x}" if code < 2**16 else "?"


def counted(number: int, thing: str, form: str = "") -> str:
    """`1 sample`, `2 samples`; of a thing whose plural is its name with an s.

    form: how the number is written, as in a format specification
    """
    return f"{number:{form}} {thing}" if number == 1 else f"{number:{form}} {thing}s"
