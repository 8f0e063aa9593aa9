"""Draw the README's picture: the terminal during a replay of the recording that comes with the project.

Lives here: running the replay and saving what it printed as SVG.
Not here: what is printed (`streamfeat.stream.sinks`).

    python tools/make_picture.py
"""

import re
from pathlib import Path

from rich._export_format import CONSOLE_SVG_FORMAT
from rich.console import Console

from streamfeat.cli import program
from streamfeat.stream.outputs import Outputs
from streamfeat.stream.replay import ReplayJob

ROOT = Path(__file__).resolve().parent.parent
PICTURE = ROOT / "tools" / "replay.svg"
COMMAND = (
    "streamfeat replay digits_test.mcap -m digits.safetensors -c digits_classifier.safetensors --speed 20"
)


def main() -> None:
    recordings = ROOT / "recordings"
    console = Console(record=True, width=92, highlight=False, force_terminal=True, color_system="truecolor")
    job = ReplayJob(
        recordings / "digits_test.mcap",
        recordings / "digits.safetensors",
        recordings / "digits_classifier.safetensors",
        speed=20.0,
    )
    job.run(Outputs(console=console))
    program.out = console
    program.print_result(job.result(), "replayed", as_json=False)
    # Without the web fonts that rich would ask for: the picture makes no request.
    plain = re.sub(r"@font-face {{.*?}}\s*", "", CONSOLE_SVG_FORMAT, flags=re.DOTALL)
    PICTURE.write_text(console.export_svg(title=COMMAND, code_format=plain))
    print(f"{PICTURE.relative_to(ROOT)}: {PICTURE.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
