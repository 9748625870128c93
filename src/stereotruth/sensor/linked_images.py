"""Which images of a site its pairs link, directly or through others.

Images that no chain of pairs links are adjusted apart, each group to the LiDAR alone, so that
between groups labels may differ by more than within them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

Names = tuple[str, str]  # of a pair's images


def new_links(pairs: Iterable[Names], links: Iterable[Names] = ()) -> list[Names]:
    """The first of the ``pairs`` that link images which neither ``links`` nor those before them
    have linked (a spanning forest, Kruskal 1956)."""
    group: dict[str, str] = {}

    def link(pair: Names) -> bool:
        one, other = (group.setdefault(name, name) for name in pair)
        if one == other:
            return False
        for name, of in group.items():
            if of == other:
                group[name] = one
        return True

    for pair in links:
        link(pair)
    return [pair for pair in pairs if link(pair)]


@dataclass(frozen=True)
class Links:
    """``groups`` of images that no pair links, by size; images that are ``unused``, in no pair."""

    groups: tuple[tuple[str, ...], ...]
    unused: tuple[str, ...]

    @classmethod
    def of(cls, images: Iterable[str], pairs: Sequence[Names]) -> Links:
        """Of all ``images`` of a site, and those that its pairs name."""
        used = {name for pair in pairs for name in pair}
        groups = {name: {name} for name in used}
        for one, other in new_links(pairs):
            both = groups[one] | groups[other]
            groups.update(dict.fromkeys(both, both))
        apart = {tuple(sorted(group)) for group in groups.values()}
        by_size = sorted(apart, key=lambda group: (-len(group), group))
        return cls(tuple(by_size), tuple(sorted(set(images) - used)))

    @property
    def sentences(self) -> list[str]:
        """What is not linked, in words; nothing where all images are."""
        said = [self.of_unused] if self.unused else []
        return [*said, self.of_groups] if len(self.groups) > 1 else said

    @property
    def of_unused(self) -> str:
        """Which images are in no pair."""
        word = "image" if len(self.unused) == 1 else "images"
        return f"{len(self.unused)} {word} in no pair: {', '.join(self.unused)}"

    @property
    def of_groups(self) -> str:
        """Which groups no pair links."""
        named = "; ".join(", ".join(group) for group in self.groups)
        return (
            f"{len(self.groups)} groups of images without a pair between them, each adjusted by "
            f"itself: {named}"
        )
