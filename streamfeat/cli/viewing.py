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
    EmitOption,
    JsonOption,
    OpenOption,
    OverwriteOption,
    QuietOption,
    ThreadsOption,
    TopicOption,
    WebPortOption,
    app,
    err,
    model_or_general,
    print_result,
    refuse_existing,
    tell_compiling,
)
from streamfeat.cli.reading import print_assumptions, reads_recordings
from streamfeat.errors import InputError
from streamfeat.files.locations import Location, StoreLocation, location_of

if TYPE_CHECKING:
    from streamfeat.recordings.options import ReadOptions

__all__ = ["view"]


@app.command(epilog="Example: streamfeat view recordings/digits_test.mcap")
@reads_recordings()
def view(
    reading: "ReadOptions",
    source: Annotated[
        str | None,
        typer.Argument(metavar="REC|KEYEXPR", help="A recording or its URL, or live topics."),
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option("--model", "-m", help="Show features, too, of this model from `streamfeat learn`."),
    ] = None,
    classifier: Annotated[
        Path | None,
        typer.Option("--classifier", "-c", help="Show predictions, too, of this classifier."),
    ] = None,
    features: Annotated[
        bool, typer.Option("--features", help="Show features of the general model, where no -m is given.")
    ] = False,
    emit: EmitOption = "auto",
    web: Annotated[
        bool | None,
        typer.Option("--web/--no-web", help="Serve the page. Served unless there is -o or --foxglove."),
    ] = None,
    web_port: WebPortOption = 8766,
    open_browser: OpenOption = None,
    foxglove: Annotated[
        bool, typer.Option("--foxglove", help="Serve the Foxglove app; extra `view`.")
    ] = False,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Where Foxglove connects, on loopback; 0 is any.")
    ] = 8765,
    origin: Annotated[
        list[str] | None,
        typer.Option(metavar="URL", help="Let this page connect, too, such as a Foxglove of your own."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Write pictures and plots to this MCAP file; extra `view`."),
    ] = None,
    layout: Annotated[Path | None, typer.Option(help="Write a Foxglove layout (JSON) here.")] = None,
    rate: Annotated[float, typer.Option(help="Pictures a second.")] = 20.0,
    speed: Annotated[
        str | None, typer.Option(help="1 is the recorded pace, 2 twice that, or max; 1 where it is served.")
    ] = None,
    loop: Annotated[bool, typer.Option("--loop", help="Start a recording again at its end.")] = False,
    split: Annotated[str | None, typer.Option(help="Only samples of this split.")] = None,
    topic: TopicOption = None,
    threads: ThreadsOption = None,
    ros2: RosOption = None,
    domain: DomainOption = 0,
    zenoh_config: ConfigOption = None,
    zenoh_port: Annotated[int, typer.Option(help="Loopback port where sessions meet.")] = 7447,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Events as they happen, in the browser: of a recording or of live topics. No model is needed.

    With a model: bins, active volumes, features and latency, too; with a classifier its scores. A recording
    begins when the page is opened, and can be paused and sought in until Ctrl-C.
    """
    from streamfeat.live.network import Network
    from streamfeat.recordings.options import AS_IT_IS
    from streamfeat.stream.replay import parse_speed
    from streamfeat.view.job import View, has_display

    if foxglove or output:
        from streamfeat.report.pages import require

        require("foxglove", extra="view", what="Foxglove and -o" if foxglove else "-o")
    for path in (output, layout):
        if path:
            refuse_existing(path, source, model, classifier, overwrite=overwrite)
    recording = _recording(source)
    on_page = web if web is not None else not (foxglove or output)
    if not (on_page or foxglove or output):
        raise InputError("--no-web shows nothing without --foxglove or -o OUT.mcap")
    options: dict[str, Any]
    if recording:
        if ros2 is not None:
            raise InputError("give a recording, or a ROS 2 topic with --ros2, not both")
        pace = parse_speed(speed or ("1" if on_page or foxglove else "max"))
        options = {"speed": pace, "topic": topic, "split": split, "loop": loop, "reading": reading}
    else:
        if loop or speed or split or topic or reading != AS_IT_IS:
            raise InputError(
                "--loop, --speed, --split, --topic and what tells how to read are for recordings"
            )
        options = {"network": Network(zenoh_config, zenoh_port), "console": err}
    job = View(
        recording or names_of(source, ros2, domain),
        model_or_general(model) if model or features or classifier else None,
        classifier,
        emit=emit,
        rate=rate,
        threads=threads,
        web_port=web_port if on_page else None,
        foxglove_port=port if foxglove else None,
        origins=origin or (),
        recording_out=output,
        open_browser=has_display() if open_browser is None else open_browser,
        say=lambda line: None if quiet else err.print(escape(line), soft_wrap=True),
        **options,
    )
    if recording:
        print_assumptions(job.assumptions)
    if model or features or classifier:
        tell_compiling(quiet=quiet)
    if layout:
        job.write_layout(layout, "" if recording else ros2 or str(source))
    job.run()
    print_result(job.result(), "viewed", as_json=as_json, command="view")


def _recording(source: str | None) -> Location | None:
    """The recording that is meant, if it is one: a URL, what exists, or what is called as one."""
    if source is None:
        return None
    place = location_of(source)
    is_there = isinstance(place, StoreLocation) or place.exists()
    return place if is_there or place.suffix in (".mcap", ".bag", ".db3") else None
