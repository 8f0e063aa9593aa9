"""Draw the README's picture of the view: the page while the recording that comes with the project is shown.

Lives here: running `streamfeat view`, looking at it in a headless Chromium, saving what is seen as PNG.
Not here: what is shown (`streamfeat.view`).

    python tools/make_view_picture.py
"""

import signal
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT / "tests"))

from browser import PATIENCE_S, Browser  # noqa: E402

PICTURE = ROOT / "tools" / "view.png"
STAND_STILL = """
  const hear = listener.onMessage;
  listener.onMessage = (camera, channel, message) => {
    if (document.body.dataset.still) return;
    hear(camera, channel, message);
    const prediction = model.cameras.get(model.camera)?.last.prediction;
    // At the end of a sample, with all bins filled, when the plots have something to show.
    if (model.scores.length >= 80 && prediction?.sample?.final) document.body.dataset.still = "yes";
  };
"""


def main() -> None:
    recordings = ROOT / "recordings"
    command = [
        *(sys.executable, "-c", "from streamfeat.cli import main; main()", "view"),
        *(str(recordings / "digits_test.mcap"), "-m", str(recordings / "digits.safetensors")),
        *("-c", str(recordings / "digits_classifier.safetensors")),
        *("--web-port", "0", "--no-open"),
    ]
    view = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    try:
        said = iter(view.stderr.readline, "")
        address = next(line.partition(": ")[2].strip() for line in said if line.startswith("page"))
        with Browser(1280, 930) as browser:
            browser.open(address)
            browser.until("Number(document.body?.dataset.frames) > 0")
            browser.value(STAND_STILL)
            browser.until("document.body.dataset.still")
            browser.screenshot(PICTURE)
    finally:
        view.send_signal(signal.SIGINT)
        view.wait(PATIENCE_S)
    print(f"{PICTURE.relative_to(ROOT)}: {PICTURE.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
