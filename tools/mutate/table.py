"""What became of each mutant: kept in `results.json`, shown as a table in `README.md`.

Lives here: reading and writing both. Not here: trying mutants (`__main__`).
"""

import json
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from tools.mutate.mutants import MUTANTS

FOLDER = Path(__file__).parent
RESULTS, README = FOLDER / "results.json", FOLDER / "README.md"
START, END = "<!-- mutants -->\n", "<!-- end of mutants -->\n"


class Outcome(NamedTuple):
    """What a mutant's tests did.

    Attributes:
        verdict: `killed`, `survived`, `no test` (pytest could not run them) or `not tried`.
        said: the line of pytest that says so.
    """

    verdict: str
    said: str

    @property
    def test(self) -> str:
        """The test that noticed, if one did."""
        words = self.said.split()
        return words[1].partition("::")[2] if words[:1] in (["FAILED"], ["ERROR"]) else ""


def outcomes() -> dict[str, Outcome]:
    """Outcomes by mutant's name, as far as they were tried."""
    found = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    return {mutant.name: Outcome(*found[mutant.name]) for mutant in MUTANTS if mutant.name in found}


def write_outcomes(found: dict[str, Outcome]) -> None:
    """Write outcomes, in the order of the list of mutants."""
    kept = {mutant.name: found[mutant.name] for mutant in MUTANTS if mutant.name in found}
    RESULTS.write_text(json.dumps(kept, indent=1) + "\n")


def table() -> str:
    """One line for each mutant, and the sum of them, as Markdown."""
    found, untried = outcomes(), Outcome("not tried", "")
    rows = [(mutant, found.get(mutant.name, untried)) for mutant in MUTANTS]
    tally = Counter(outcome.verdict for _, outcome in rows)
    counts = ", ".join(f"{tally[verdict]} {verdict}" for verdict in sorted(tally))
    lines = [f"{len(rows)} mutants: {counts}.", "", "| file | mutant | | noticed by |", "|---|---|---|---|"]
    for mutant, outcome in rows:
        why = mutant.why if outcome.verdict == "survived" else f"`{outcome.test}`" if outcome.test else ""
        lines.append(f"| `{mutant.file}` | {mutant.name} | {outcome.verdict} | {why} |")
    return "\n".join(lines) + "\n"


def page(text: str) -> str:
    """The text of the page with its table written anew."""
    before, _, rest = text.partition(START)
    _, _, after = rest.partition(END)
    return f"{before}{START}{table()}{END}{after}"
