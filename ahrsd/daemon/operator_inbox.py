"""A person's word to the running daemon, and its answer: files in the folder `STATE/operator/`.

Who may write into the folder may approve a write, so it must belong to the daemon's user or to root
and nobody else may write there; anything else is refused by name, at the start and each time.

    NAME.json     a word, {"verb": "lock", "argument": "crew aboard"}: removed before it acts
    NAME.answer   what became of it, {"accepted": false, "text": "..."}: the caller removes it

A word is one of this run where it appeared after the daemon began to look, by a clock that is never
set; what lay there before is dropped and answered so. Both kinds of file can be read by the other
side whatever the umask of who made them: the folder keeps everybody else out.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import logging
import os
import stat
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from queue import SimpleQueue
from typing import Final

from ahrsd.foreign_file import ForeignFileError, boot_s, kind_of, read_regular
from ahrsd.recording.capture import make_private_folder

VERBS: Final = ("arm", "disarm", "approve", "lock", "unlock", "rollback")
LONGEST_S: Final = 30.0
_LARGEST_BYTES = 1024
_MOST_ENTRIES = 4096  # entries of the folder that are read in one turn
_EVERY_S = 0.1  # interval at which the folder is read
_ANSWERS_S = 60.0  # an answer that nobody fetched is removed
_ASK_S = 0.02  # interval at which a command looks for its answer
_READABLE = 0o644  # in a folder that only its owner may enter

log = logging.getLogger(__name__)


class OperatorFolderError(OSError):
    """The folder cannot be trusted, or cannot be used; the text names it and says what helps."""


class NoAnswerInTime(Exception):
    """The daemon took the command and did not answer within the time limit."""


@dataclass(frozen=True, slots=True)
class OperatorCommand:
    """A command of a person; `name` is that of its file, and of the answer's."""

    name: str
    verb: str
    argument: str


@dataclass(frozen=True, slots=True)
class OperatorAnswer:
    """Whether a command was accepted, and why not or what follows."""

    accepted: bool
    text: str


class OperatorBox:
    """The folder, for both sides."""

    def __init__(self, state_directory: Path) -> None:
        self.folder = state_directory / "operator"

    def prepare(self) -> None:
        """Make the folder for this user alone. Raises OperatorFolderError, OSError."""
        make_private_folder(self.folder.parent)
        with suppress(FileExistsError):
            self.folder.mkdir(mode=0o700)
            self.folder.chmod(0o700)  # whatever the umask
        with self.open():
            pass

    @contextmanager
    def open(self, *, ours: bool = True) -> Iterator[int]:
        """A descriptor of the folder itself, once it is what it must be. Raises OSError.

        ours: it must belong to this user or to root; a caller only needs to be let in
        """
        flags = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        try:
            found = os.open(self.folder, flags)
        except OSError as error:
            if error.errno in (errno.ENOTDIR, errno.ELOOP):
                raise OperatorFolderError(f"{self.folder}: is not a folder; remove it") from error
            raise
        try:
            status = os.fstat(found)
            if ours and status.st_uid not in (os.geteuid(), 0):
                raise OperatorFolderError(
                    f"{self.folder}: belongs to user {status.st_uid}, who could approve writes; "
                    "remove it, and start the daemon again"
                )
            if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
                raise OperatorFolderError(
                    f"{self.folder}: others than its owner may write there (mode "
                    f"{stat.S_IMODE(status.st_mode):04o}) and could approve writes; look at what "
                    f"is in it, then: chmod 700 {self.folder}"
                )
            yield found
        finally:
            os.close(found)

    # -- the caller's side -------------------------------------------------------------------------

    def put(self, verb: str, argument: str = "") -> str:
        """Say a word; returns the name of its file. Raises OSError."""
        name = f"{time.time_ns()}-{os.getpid()}"
        body = json.dumps({"verb": verb, "argument": argument}).encode()
        if len(body) > _LARGEST_BYTES:
            raise OperatorFolderError(f"the text is too long: {len(body)} bytes")
        with self.open(ours=False) as folder:
            owner = os.fstat(folder)
            _write(folder, f"{name}.json", body, (owner.st_uid, owner.st_gid))
        return name

    def say(self, verb: str, argument: str, wait_s: float) -> OperatorAnswer | None:
        """Say a word and wait for the answer; None where nobody took it, then it is gone.

        Raises NoAnswerInTime, OSError.
        """
        name, until_s = self.put(verb, argument), boot_s() + wait_s
        word, answer = self.folder / f"{name}.json", self.folder / f"{name}.answer"
        while word.exists():
            if boot_s() > until_s and _removed(word):
                return None
            time.sleep(_ASK_S)
        until_s = boot_s() + wait_s
        while boot_s() <= until_s:
            with suppress(ForeignFileError):
                body = json.loads(read_regular(answer, 4 * _LARGEST_BYTES, follow=False).data)
                _removed(answer)
                return OperatorAnswer(bool(body["accepted"]), str(body["text"]))
            time.sleep(_ASK_S)
        raise NoAnswerInTime(f"took the command and did not answer within {wait_s:.0f} s")


class OperatorInbox:
    """The daemon's side: words come out of `take`, answers go into `answer`; neither waits.

    The folder is looked at in a thread of its own. `woken` is called from there after each word.
    """

    def __init__(self, box: OperatorBox, woken: Callable[[], None] = lambda: None) -> None:
        self.box, self.woken = box, woken
        self.fault = ""  # what is wrong with the folder now, in one line
        self._words: SimpleQueue[OperatorCommand] = SimpleQueue()
        self._answers: SimpleQueue[tuple[str, OperatorAnswer]] = SimpleQueue()
        self._answered: dict[str, float] = {}
        self._odd: set[str] = set()
        self._looked_s: float | None = None
        self._held: int | None = None  # a descriptor of the folder, locked for this daemon
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._work, name="operator", daemon=True)
        self._thread.start()

    @staticmethod
    def in_state(state_directory: Path) -> OperatorInbox:
        """That of a daemon with this state directory."""
        box = OperatorBox(state_directory)
        with contextlib.suppress(OSError):  # the inbox says why, and when it is over
            box.prepare()
        return OperatorInbox(box)

    def take(self) -> list[OperatorCommand]:
        """The words since the last time, oldest first."""
        found = []
        while not self._words.empty():
            found.append(self._words.get())
        return found

    def answer(self, name: str, answer: OperatorAnswer) -> None:
        """Tell whoever said the word of this name what became of it."""
        self._answers.put((name, answer))

    def close(self, timeout_s: float) -> None:
        """Give the answers that are due and look no more; a disk that hangs is left to itself."""
        self._closing.set()
        self._thread.join(timeout_s)

    def _work(self) -> None:
        closing = False
        while not closing:
            closing = self._closing.wait(_EVERY_S)
            try:
                with self.box.open() as folder:
                    self._hold(folder)
                    self._look(folder, boot_s())
                self.fault = ""
            except OSError as error:
                named = isinstance(error, OperatorFolderError)
                text = error if named else f"{self.box.folder}: {error.strerror}"
                self.fault = f"{text}; until then nobody can approve"
                self._looked_s = None  # what is found there afterwards may be anybody's
        self._let_go()

    def _hold(self, folder: int) -> None:
        """Keep other daemons from taking this folder's commands. Raises OperatorFolderError."""
        if self._held is not None and os.path.sameopenfile(self._held, folder):
            return
        self._let_go()
        held = os.dup(folder)
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(held)
            raise OperatorFolderError(
                f"{self.box.folder}: another daemon takes the commands; give each daemon a state "
                "directory of its own (--state-directory)"
            ) from None
        except OSError as error:  # a file system without locks
            log.debug("operator: %s cannot be locked: %s", self.box.folder, error.strerror)
        self._held = held

    def _let_go(self) -> None:
        if self._held is not None:
            os.close(self._held)
            self._held = None

    def _look(self, folder: int, now_s: float) -> None:
        """One turn: answers out, words in, what is too old away."""
        while not self._answers.empty():
            name, answer = self._answers.get()
            self._tell(folder, name, answer, now_s)
        with os.scandir(folder) as entries:
            names = sorted(entry.name for entry in islice(entries, _MOST_ENTRIES))
        first = self._looked_s is None
        late = (
            "it was there before this run of the daemon started to read commands" if first else ""
        )
        if not first and now_s - (self._looked_s or now_s) > LONGEST_S:
            late = f"the daemon read no commands for more than {LONGEST_S:.0f} s"
        self._looked_s = now_s
        for name in names:
            if name.endswith(".json") and not name.startswith("."):
                self._hear(folder, name, late, now_s)
            elif name.endswith(".answer") and now_s - self._answered.get(name, 0.0) > _ANSWERS_S:
                _removed(name, folder)
        self._odd &= set(names)
        kept = {n: s for n, s in self._answered.items() if now_s - s <= _ANSWERS_S}
        self._answered = kept

    def _hear(self, folder: int, name: str, late: str, now_s: float) -> None:
        stem = name.removesuffix(".json")
        try:
            status = os.stat(name, dir_fd=folder, follow_symlinks=False)
            if kind_of(status.st_mode):
                raise ForeignFileError(f"is {kind_of(status.st_mode)}")
            try:
                data = read_regular(name, _LARGEST_BYTES, follow=False, folder=folder).data
            finally:
                os.unlink(name, dir_fd=folder)
            word = _word_of(stem, data)
        except (OSError, ForeignFileError) as error:
            if name not in self._odd and not isinstance(error, FileNotFoundError):
                text = f"{name} is not a command: {getattr(error, 'strerror', None) or error}"
                log.warning("operator: %s; use `ahrsd operator`", text)
                self._tell(folder, stem, OperatorAnswer(False, text), now_s)
            self._odd.add(name)
            return
        if late:
            log.warning("operator: %s was dropped: %s", word.verb, late)
            self._tell(
                folder, stem, OperatorAnswer(False, f"dropped: {late}; send it again"), now_s
            )
            return
        self._words.put(word)
        self.woken()

    def _tell(self, folder: int, name: str, answer: OperatorAnswer, now_s: float) -> None:
        body = json.dumps({"accepted": answer.accepted, "text": answer.text}).encode()
        try:
            _write(folder, f"{name}.answer", body, None)
        except OSError as error:
            log.warning("operator: the answer to %s was not given: %s", name, error.strerror)
        self._answered[f"{name}.answer"] = now_s


def _write(folder: int, name: str, body: bytes, owner: tuple[int, int] | None) -> None:
    """A file, whole or not at all, that its reader can read whatever the umask. Raises OSError."""
    draft = f".{name}"
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    descriptor = os.open(draft, flags, 0o600, dir_fd=folder)
    try:
        os.write(descriptor, body)
        if owner is not None:
            with suppress(PermissionError):  # only root gives files away; its mode does as well
                os.fchown(descriptor, *owner)
        os.fchmod(descriptor, _READABLE)
    finally:
        os.close(descriptor)
    os.rename(draft, name, src_dir_fd=folder, dst_dir_fd=folder)


def _removed(file: Path | str, folder: int | None = None) -> bool:
    """Remove a file; whether it was there."""
    try:
        os.unlink(file, dir_fd=folder)
    except FileNotFoundError:
        return False
    return True


def _word_of(name: str, data: bytes) -> OperatorCommand:
    """The word in a file's bytes. Raises ForeignFileError where it is none."""
    try:
        body = json.loads(data)
        verb, argument = body["verb"], body["argument"]
    except (ValueError, TypeError, KeyError, RecursionError):
        verb, argument = None, None
    if verb not in VERBS or not isinstance(argument, str):
        raise ForeignFileError("it does not hold a verb and a text")
    return OperatorCommand(name, verb, argument)
