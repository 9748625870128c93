"""The rules of the workflow, as their files state them."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from .project import ROOT

FOLDER = ROOT / "workflow"


@dataclass
class Rule:
    """Directives of a rule by name, as text; what ``use rule`` does not state is its parent's."""

    name: str
    directives: dict[str, str] = field(default_factory=dict)

    @property
    def script(self) -> str | None:
        """Name of the script that the rule runs, if it runs one."""
        found = re.search(r'"\.\./scripts/(\w+)\.py"', self.directives.get("script", ""))
        return found and found[1]

    def digests(self) -> dict[str, list[str]]:
        """The modules named in each ``source_digest(…)`` of the params, by the param's name."""
        calls = re.findall(
            r"^ *(\w+)=(?:lambda \w+: )?source_digest\((.*?)\),\n",
            self.directives.get("params", "") + "\n",
            flags=re.MULTILINE | re.DOTALL,
        )
        return {name: re.findall(r'"([\w.]+)"', text) for name, text in calls}

    def digest_of_method(self) -> bool:
        """Whether a digest takes in the modules of a stereo method's kind."""
        return "method_modules(" in self.directives.get("params", "")


def read_rules() -> dict[str, Rule]:
    """All rules by name."""
    rules: dict[str, Rule] = {}
    for file in sorted((FOLDER / "rules").glob("*.smk")):
        text = file.read_text(encoding="utf-8")
        for block in re.split(r"^(?=rule |use rule )", text, flags=re.MULTILINE)[1:]:
            parent, name = re.match(r"(?:use rule (\w+) as|rule) (\w+)", block).groups()
            own = re.findall(r"^    (\w+):\n((?:^ {8}.*\n|^\n)+)", block + "\n", flags=re.MULTILINE)
            rules[name] = Rule(name, {**(rules[parent].directives if parent else {}), **dict(own)})
    return rules
