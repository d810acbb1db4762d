"""Keys of a terminal, one at a time and without echo, in a thread beside what is drawn."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator

_NAMES = {
    "\x1b[A": "up",
    "\x1b[B": "down",
    "\x1b[5~": "page up",
    "\x1b[6~": "page down",
    "\x1b[H": "home",
}
_PIECE = 16
_LOOK_S = 0.2


@contextlib.contextmanager
def keys(pressed: Callable[[str], None]) -> Iterator[None]:
    """Call `pressed` with each key until the block ends; the terminal is as before then.

    Nothing is read where stdin is no terminal. Ctrl-C stays what it is.
    """
    if not sys.stdin.isatty():
        yield
        return
    terminal, ended = sys.stdin.fileno(), threading.Event()
    before = termios.tcgetattr(terminal)
    tty.setcbreak(terminal)
    thread = threading.Thread(target=_read, args=(terminal, pressed, ended), daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(2 * _LOOK_S)
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def _read(terminal: int, pressed: Callable[[str], None], ended: threading.Event) -> None:
    while not ended.is_set():
        if not select.select([terminal], [], [], _LOOK_S)[0]:
            continue
        text = os.read(terminal, _PIECE).decode(errors="replace")
        if not text:
            return
        for key in [_NAMES[text]] if text in _NAMES else text:
            pressed(key)
