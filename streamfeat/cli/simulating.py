"""The command `simulate`: recordings from images and films.

Lives here: its arguments, and how its result is shown.
Not here: the simulation (`simulate`, `convert.simulation`).
"""

import re
from pathlib import Path
from typing import Annotated, cast

import typer

from streamfeat.cli.program import (
    ClusterOption,
    JsonOption,
    OverwriteOption,
    QuietOption,
    WorkersOption,
    app,
    completing,
    print_result,
    refuse_existing,
    working,
)
from streamfeat.cli.progress import progress_bars
from streamfeat.cli.recordings import (
    GapOption,
    HoldOutOption,
    InterleavedOption,
    LimitOption,
    listed_faults,
    print_faults,
)
from streamfeat.errors import InputError

__all__ = ["simulate"]

_MOST_SIDE = 1 << 14


@app.command(epilog="Example: streamfeat simulate 101_ObjectCategories caltech.mcap --interleaved 5")
def simulate(
    source: Annotated[
        Path,
        typer.Argument(metavar="IN", help="Folder LABEL/IMAGE, video, or folder with the frames of one."),
    ],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="Recording to write, .mcap.")],
    resolution: Annotated[
        str | None,
        typer.Option(metavar="WxH", help="Largest sensor.", show_default="240x180; of a film its own size"),
    ] = None,
    border: Annotated[
        str,
        typer.Option(
            help="crop: the sensor never sees the border of an image (N-Caltech101); black: all around is "
            "black; edge: all around is as its border (N-MNIST: dark digits on white).",
            autocompletion=completing("crop", "black", "edge"),
        ),
    ] = "crop",
    amplitude: Annotated[float, typer.Option(help="Pixels that images move to each side.")] = 3.5,
    threshold: Annotated[float, typer.Option(help="Change of log intensity that makes an event.")] = 0.28,
    mismatch: Annotated[float, typer.Option(help="Spread of the thresholds' logarithm over pixels.")] = 0.1,
    refractory_us: Annotated[int, typer.Option(help="Microseconds a pixel is dead after an event.")] = 1_000,
    noise_hz: Annotated[float, typer.Option(help="Background events per pixel and second.")] = 0.2,
    bandwidth_hz: Annotated[
        float, typer.Option(help="Cut-off frequency of the photoreceptors; 0 for none.")
    ] = 0.0,
    black_level: Annotated[float, typer.Option(help="Light from black, relative to white.")] = 0.08,
    gamma: Annotated[float, typer.Option(help="From grey values to light; 1 if they are light.")] = 2.2,
    fps: Annotated[
        float | None, typer.Option(help="Frames a second of a folder of frames.", show_default="30")
    ] = None,
    label: Annotated[str | None, typer.Option(help="Label of a film, all of it.")] = None,
    hold_out: HoldOutOption = None,
    interleaved: InterleavedOption = None,
    split: Annotated[str | None, typer.Option(help="Split of all samples, whatever folders say.")] = None,
    limit: LimitOption = None,
    gap_ms: GapOption = 1000.0,
    seed: Annotated[int, typer.Option(min=0, help="Of noise and mismatch.")] = 0,
    cluster: ClusterOption = None,
    workers: WorkersOption = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="List every file with a fault.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Events that a camera would see: of images, looked at with saccades, or of a film; with labels.

    The same bits for a seed, on any number of workers. Images that cannot be read are reported, and the
    others simulated; the exit status is 1 then.
    """
    from streamfeat.convert import simulation
    from streamfeat.convert.splits import parse_hold_out
    from streamfeat.recordings.reader import Label
    from streamfeat.simulate.camera import CameraModel
    from streamfeat.simulate.films import open_film

    if target.suffix.lower() != ".mcap":
        raise InputError(f"{target}: recordings end in .mcap; `streamfeat convert` makes other files of them")
    if not source.exists():
        raise InputError(f"{source}: does not exist")
    refuse_existing(target, source, overwrite=overwrite)
    if not 0 < gap_ms < 1e9:
        raise InputError(f"a gap of {gap_ms} ms is not possible; give at least one window")
    if not 0.01 <= threshold <= 10 or not 0.001 <= black_level <= 10:
        raise InputError("--threshold is from 0.01 to 10, --black-level from 0.001 to 10")
    if not (0 <= mismatch <= 1 and 0 <= refractory_us <= 10**9 and 0 <= noise_hz <= 1e4):
        raise InputError("--mismatch is from 0 to 1, --refractory-us to 10^9, --noise-hz to 10^4")
    if not 0 <= bandwidth_hz <= 1e6 or not (fps is None or 0.001 <= fps <= 1e6):
        raise InputError("--bandwidth-hz is from 0 to 10^6, --fps from 0.001 to 10^6")
    box = _box(resolution)
    scene = simulation.Scene(
        CameraModel(
            box or simulation.MONITOR_CAMERA.resolution,
            threshold,
            mismatch,
            seed,
            refractory_us,
            noise_hz,
            black_level,
            bandwidth_hz,
        ),
        amplitude,
        cast(simulation.Border, border),
        gamma,
        seed,
    )
    chosen = {"hold_out": hold_out, "interleaved": interleaved, "limit": limit}
    if simulation.is_image_folder(source):
        if fps is not None or label is not None:
            raise InputError(f"{source}: is a folder LABEL/IMAGE; --fps and --label are for films")
        block = parse_hold_out(hold_out) if hold_out is not None else None
        with working(cluster, workers, quiet=quiet) as place, progress_bars(quiet=quiet) as report:
            done = simulation.simulate_images(
                source.absolute(),
                target,
                scene,
                overwrite=overwrite,
                gap_us=round(gap_ms * 1000),
                split=split,
                hold_out=block,
                interleaved=interleaved,
                limit=limit,
                progress=lambda n, total: report("simulating", n, total, ""),
                workers=place,
            )
    else:
        if given := [f"--{name.replace('_', '-')}" for name, value in chosen.items() if value is not None]:
            raise InputError(f"{source}: is a film; {', '.join(given)} is for folders LABEL/IMAGE")
        film = open_film(source, box, fps)
        with progress_bars(quiet=quiet) as report:
            done = simulation.simulate_film(
                film,
                target,
                scene,
                label=None if label is None else Label(0, 0, label, split or "", source.name),
                overwrite=overwrite,
                progress=lambda n, total: report("simulating", n, total, ""),
            )
    result = {
        "written": str(target),
        "samples": done.samples,
        "events": done.events,
        "bytes_out": done.bytes_out,
        "failed": len(done.failed),
        "damaged": len(done.damaged),
    }
    faults = {"failed": done.failed, "damaged": done.damaged}
    if as_json:
        result["faults"] = listed_faults(faults)
    print_result(result, "simulated", as_json=as_json, command="simulate")
    print_faults(faults, verbose=verbose)
    if done.failed or done.damaged:
        raise typer.Exit(1)


def _box(text: str | None) -> tuple[int, int] | None:
    """Height and width of `240x180`.

    Raises:
        InputError: it is something else.
    """
    if text is None:
        return None
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text.strip())
    width, height = (int(found[1]), int(found[2])) if found else (0, 0)
    if not (1 <= width <= _MOST_SIDE and 1 <= height <= _MOST_SIDE):
        raise InputError(f"--resolution {text!r} is not understood; give width and height, such as 240x180")
    return height, width
