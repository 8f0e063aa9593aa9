"""The command to look on: view.

Lives here: its arguments, and what it says while it runs.
Not here: the view (`streamfeat.view`).
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from streamfeat.cli.live import ConfigOption, DomainOption, RosOption, names_of
from streamfeat.cli.program import (
    JsonOption,
    ModelOption,
    OverwriteOption,
    QuietOption,
    TopicOption,
    app,
    err,
    print_result,
    progress_bars,
    refuse_existing,
)
from streamfeat.cli.reading import print_assumptions, reads_recordings
from streamfeat.errors import InputError
from streamfeat.files.locations import Location, StoreLocation, location_of

if TYPE_CHECKING:
    from streamfeat.recordings.options import ReadOptions

__all__ = ["view"]


@app.command(
    epilog="Example: streamfeat view recordings/digits_test.mcap -m recordings/digits.safetensors "
    "-c recordings/digits_classifier.safetensors --web"
)
@reads_recordings()
def view(
    model: ModelOption,
    reading: "ReadOptions",
    source: Annotated[
        str | None,
        typer.Argument(metavar="REC|KEYEXPR", help="MCAP recording or its URL, or live topics."),
    ] = None,
    classifier: Annotated[
        Path | None, typer.Option("--classifier", "-c", help="Classifier, from `streamfeat train`.")
    ] = None,
    emit: Annotated[str, typer.Option(help="When to read features: event, 1000ev, 10ms or auto.")] = "auto",
    web: Annotated[bool, typer.Option("--web", help="Serve a page for the browser, too.")] = False,
    web_port: Annotated[int, typer.Option(min=0, max=65535, help="Where, on loopback; 0 is any.")] = 8766,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Where Foxglove connects, on loopback; 0 is any.")
    ] = 8765,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Write pictures and plots to this MCAP file, for Foxglove."),
    ] = None,
    live: Annotated[
        bool | None,
        typer.Option(
            "--live/--no-live", help="Serve, or only write -o. ServedCamera unless there is only -o."
        ),
    ] = None,
    layout: Annotated[Path | None, typer.Option(help="Write a Foxglove layout (JSON) here.")] = None,
    rate: Annotated[float, typer.Option(help="Looks a second.")] = 20.0,
    speed: Annotated[
        str | None, typer.Option(help="1 is the recorded pace, 2 twice that, or max; 1 where it is served.")
    ] = None,
    loop: Annotated[bool, typer.Option("--loop", help="Start a recording again at its end.")] = False,
    split: Annotated[str | None, typer.Option(help="Only samples of this split.")] = None,
    topic: TopicOption = None,
    ros2: RosOption = None,
    domain: DomainOption = 0,
    zenoh_config: ConfigOption = None,
    zenoh_port: Annotated[int, typer.Option(help="Loopback port where sessions meet.")] = 7447,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Events, bins, volumes, features, scores, latency and drops as they happen; a recording or live topics.

    A recording that is served begins when somebody looks, and its last picture stays until Ctrl-C.
    """
    from streamfeat.report.pages import require

    require("foxglove", extra="view", what="a view")
    from streamfeat.recordings.options import AS_IT_IS
    from streamfeat.view.job import View

    for path in (output, layout):
        if path:
            refuse_existing(path, overwrite=overwrite)
    recording = _recording(source)
    served = live if live is not None else web or output is None
    if not served and output is None:
        raise InputError("--no-live shows nothing without -o OUT.mcap")
    if web and not served:
        raise InputError("--web needs what --no-live leaves out")
    options: dict[str, Any]
    if recording:
        if ros2 is not None:
            raise InputError("give a recording, or a ROS 2 topic with --ros2, not both")
        options = {
            "speed": speed or ("1" if served else "max"),
            "topic": topic,
            "split": split,
            "reading": reading,
        }
    else:
        if loop or speed or split or topic or reading != AS_IT_IS:
            raise InputError(
                "--loop, --speed, --split, --topic and what tells how to read are for recordings"
            )
        options = {"zenoh_config": zenoh_config, "port": zenoh_port, "console": err}
    job = View(
        recording or names_of(source, ros2, domain),
        model,
        classifier,
        emit=emit,
        rate=rate,
        live_port=port if served else None,
        web_port=web_port if web else None,
        recording_out=output,
        say=lambda line: None if quiet else err.print(escape(line), soft_wrap=True),
        **options,
    )
    if recording:
        print_assumptions(job.assumptions)
    if layout:
        job.write_layout(layout, "" if recording else ros2 or str(source))
    with progress_bars(quiet=quiet) as report:
        job.run(**({"loop": loop, "report": report} if recording else {"publish": False}))
    print_result(job.result(), "viewed", as_json=as_json)


def _recording(source: str | None) -> Location | None:
    """The recording that is meant, if it is one: a URL, what exists, or what is called as one."""
    if source is None:
        return None
    place = location_of(source)
    is_there = isinstance(place, StoreLocation) or place.exists()
    return place if is_there or place.suffix in (".mcap", ".bag", ".db3") else None
