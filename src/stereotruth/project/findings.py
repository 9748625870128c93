"""What a check has to say."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum

from ..core.errors import InputError, told_by_system
from ..core.tables import SheetError


class Level(Enum):
    """What a finding means for a run."""

    FACT = "ok"
    DOUBT = "doubt"  # a run goes through, and may not give what is wanted
    ERROR = "error"  # a run would fail of it


@dataclass(frozen=True)
class Finding:
    """One line of the table: of which scene or city, of what, and what to do about it."""

    scene: str
    about: str
    level: Level
    text: str
    remedy: str = ""


class Findings(list[Finding]):
    """What is found of one scene; InputErrors and warnings of the stages become findings."""

    def __init__(self, scene: str = "") -> None:
        super().__init__()
        self.scene = scene

    def say(self, about: str, level: Level, text: str, remedy: str = "") -> None:
        """Add a finding, once."""
        if not any((f.about, f.level, f.text) == (about, level, text) for f in self):
            self.append(Finding(self.scene, about, level, text, remedy))

    def error(self, about: str, error: InputError) -> None:
        """Add what a stage refuses; of a sheet all that is wrong in it."""
        for each in error.each if isinstance(error, SheetError) else (error,):
            where = f"{each.file}: " if each.file else ""
            self.say(about, Level.ERROR, f"{where}{each.problem}", each.remedy)

    @contextmanager
    def of(self, about: str) -> Iterator[None]:
        """In the block, an InputError is a finding, after which the block ends; warnings too.

        So is what the operating system refuses.
        """
        heard: list[str] = []
        handler = _Listener(heard)
        log = logging.getLogger("stereotruth")
        log.addHandler(handler)
        try:
            yield
        except InputError as error:
            self.error(about, error)
        except OSError as error:  # no permission, or gone in this moment
            if (told := told_by_system(error)) is None:
                raise
            self.error(about, told)
        finally:
            log.removeHandler(handler)
        for text in heard:
            self.say(about, Level.DOUBT, text.removeprefix("warning: "))

    @property
    def failed(self) -> bool:
        """Whether a run would fail."""
        return any(finding.level is Level.ERROR for finding in self)


class _Listener(logging.Handler):
    def __init__(self, heard: list[str]) -> None:
        super().__init__(logging.WARNING)
        self.heard = heard

    def emit(self, record: logging.LogRecord) -> None:
        self.heard.append(record.getMessage())
