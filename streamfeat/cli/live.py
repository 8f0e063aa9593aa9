"""Commands for live topics: listen, publish, record, recover, topics.

Lives here: their arguments, and how their results are shown.
Not here: the jobs (`live`).
"""

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from streamfeat.cli.program import (
    AnyLocation,
    ClusterOption,
    EmitOption,
    JsonOption,
    ModelOption,
    OverwriteOption,
    QuietOption,
    SpeedOption,
    ThreadsOption,
    TopicOption,
    VerboseOption,
    WorkersOption,
    app,
    completing,
    err,
    model_or_general,
    out,
    print_json,
    print_losses,
    print_result,
    refuse_existing,
    tell_compiling,
    working,
)
from streamfeat.cli.progress import progress_bars
from streamfeat.cli.reading import (
    HotPixels,
    Isolated,
    Refractory,
    denoising_of,
    print_assumptions,
    reads_recordings,
)
from streamfeat.errors import InputError
from streamfeat.files.locations import location_of

if TYPE_CHECKING:
    from streamfeat.live.names import Names
    from streamfeat.recordings.options import ReadOptions

__all__ = ["listen", "publish", "record", "recover", "topics"]

KeyArgument = Annotated[
    str | None, typer.Argument(metavar="KEYEXPR", help="zenoh key expression, such as robot/*/events.")
]
RosOption = Annotated[
    str | None, typer.Option("--ros2", metavar="TOPIC", help="ROS 2 topic (rmw_zenoh) instead of a key.")
]
DomainOption = Annotated[int, typer.Option(help="ROS_DOMAIN_ID, with --ros2.")]
DistroOption = Annotated[
    str,
    typer.Option(
        "--ros2-distro",
        help="ROS 2 of those that hear what is published: humble has no type hashes in its keys.",
        autocompletion=completing("humble", "jazzy", "rolling"),
    ),
]
ReliableOption = Annotated[
    bool, typer.Option("--reliable", help="Recover missed packets; both ends must ask for it.")
]
ConfigOption = Annotated[
    Path | None,
    typer.Option("--zenoh-config", metavar="FILE", help="zenoh configuration (JSON5); else loopback only."),
]
PortOption = Annotated[int, typer.Option(help="Loopback port where sessions meet; without --zenoh-config.")]


def has_hashes(distro: str) -> bool:
    """Whether keys of a distribution of ROS 2 have type hashes.

    Raises:
        InputError: it is unknown.
    """
    from streamfeat.live.names import ROS_DISTROS

    if distro.lower() not in ROS_DISTROS:
        raise InputError(f"--ros2-distro {distro} is unknown; known are {', '.join(ROS_DISTROS)}")
    return ROS_DISTROS[distro.lower()]


def names_of(key: str | None, ros2: str | None, domain: int, distro: str = "jazzy") -> "Names":
    from streamfeat.live.names import PlainNames, RosNames

    if (key is None) == (ros2 is None):
        raise InputError("give a zenoh key expression, or a ROS 2 topic with --ros2")
    if ros2 is not None:
        return RosNames(ros2, domain, has_hashes(distro))
    return PlainNames(str(key))


@app.command(
    epilog="Example: streamfeat listen 'robot/*/events' -m recordings/digits.safetensors "
    "-c recordings/digits_classifier.safetensors"
)
def listen(
    key: KeyArgument = None,
    model: ModelOption = None,
    classifier: Annotated[
        Path | None, typer.Option("--classifier", "-c", help="Classifier, from `streamfeat train`.")
    ] = None,
    emit: EmitOption = "auto",
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Write features and predictions to this MCAP file.")
    ] = None,
    json_lines: Annotated[
        Path | None,
        typer.Option(help="Write a JSON line for each emission to this file; - is stdout."),
    ] = None,
    features: Annotated[bool, typer.Option("--features", help="Include features in JSON lines.")] = False,
    table: Annotated[
        Path | None,
        typer.Option(help="Write features and predictions to this .parquet or .arrow file; extra `export`."),
    ] = None,
    learn_online: Annotated[
        bool, typer.Option("--learn-online", help="Learn from labels published beside the events.")
    ] = False,
    hot_pixels: HotPixels = None,
    refractory: Refractory = None,
    isolated: Isolated = None,
    ros2: RosOption = None,
    domain: DomainOption = 0,
    ros2_distro: DistroOption = "jazzy",
    reliable: ReliableOption = False,
    max_delay: Annotated[
        float, typer.Option(help="Seconds that packets may wait before the oldest are dropped.")
    ] = 1.0,
    state: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Keep what is needed to go on after a crash in this file; with --cluster a folder.",
        ),
    ] = None,
    metrics: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Serve Prometheus metrics there.")
    ] = None,
    shard: Annotated[
        str | None,
        typer.Option(metavar="I/N", help="Serve one of N fixed shares of the cameras, I from 0 to N - 1."),
    ] = None,
    announced: Annotated[
        bool,
        typer.Option(
            "--announced",
            help="Hear only cameras with a liveliness token; packets of others are not sent here.",
        ),
    ] = False,
    threads: ThreadsOption = None,
    cluster: ClusterOption = None,
    workers: WorkersOption = None,
    zenoh_config: ConfigOption = None,
    port: PortOption = 7447,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
    as_json: JsonOption = False,
) -> None:
    """Live topics to features and predictions: an engine for each camera, results published beside it."""
    from streamfeat.live.listen import ListenJob
    from streamfeat.live.network import Network
    from streamfeat.live.shard import Shard
    from streamfeat.stream.outputs import Outputs

    for path in (output, json_lines, table):
        if path and str(path) != "-":
            refuse_existing(path, model, classifier, state, overwrite=overwrite)
    names = names_of(key, ros2, domain, ros2_distro)
    chosen = model_or_general(model)
    common: dict[str, Any] = {
        "emit": emit,
        "learn_online": learn_online,
        "denoising": denoising_of(hot_pixels, refractory, isolated) or None,
        "network": Network(zenoh_config, port, reliable),
        "max_delay_s": max_delay,
        "state": state,
        "threads": threads,
    }
    if cluster is not None or workers is not None:
        if output or json_lines or table or metrics or shard or announced:
            raise InputError(
                "on a cluster cameras need no --shard and no --announced, and features and predictions go to "
                "the network: leave out --output, --json-lines, --table and --metrics, or use `record`"
            )
        common["threads"] = 1 if threads is None else threads  # its workers are as many as there are cores
        _spread(names, chosen, classifier, common, cluster, workers, quiet=quiet, as_json=as_json)
        return
    share = Shard.parse(shard) if shard is not None else None
    job = ListenJob(
        names, chosen, classifier, metrics=metrics, shard=share, announced=announced, console=err, **common
    )
    to_terminal = str(json_lines) == "-"
    tell_compiling(quiet=quiet)
    job.run(
        Outputs(
            console=None if quiet or as_json or to_terminal else out,
            every_sample=verbose,
            recording=output,
            json_lines=sys.stdout if to_terminal else json_lines,
            with_features=features,
            table=table,
        )
    )
    if not to_terminal:
        print_result(job.result(), "heard", as_json=as_json, command="listen")


def _spread(
    names: "Names",
    model: Path,
    classifier: Path | None,
    common: dict[str, Any],
    cluster: str | None,
    workers: int | None,
    *,
    quiet: bool,
    as_json: bool,
) -> None:
    """`listen` on the workers of a cluster."""
    from streamfeat.live.cluster import ClusterListen

    with working(cluster, workers, quiet=quiet) as place:
        say = (lambda line: None) if quiet else partial(err.print, markup=False, soft_wrap=True)
        job = ClusterListen(names, place, model, classifier, say=say, **common)  # type: ignore[arg-type]
        job.run()
    result = job.result()
    print_result(result, names.expression, as_json=as_json, command="listen --cluster")


@app.command(epilog="Example: streamfeat publish recordings/digits_test.mcap robot/cam0/events --loop")
@reads_recordings()
def publish(
    sources: Annotated[
        list[str],
        typer.Argument(metavar="REC KEY...", help="Recordings, each followed by the key it is published on."),
    ],
    reading: "ReadOptions",
    topic: TopicOption = None,
    speed: SpeedOption = "1",
    loop: Annotated[bool, typer.Option("--loop", help="Start again at the end.")] = False,
    encoding: Annotated[
        str,
        typer.Option(
            help="Payload: mono, libcaer_cmp, libcaer or evt3.",
            autocompletion=completing("mono", "libcaer_cmp", "libcaer", "evt3"),
        ),
    ] = "mono",
    wait: Annotated[float, typer.Option(help="Seconds to wait for a subscriber.")] = 1.0,
    ros2: Annotated[bool, typer.Option("--ros2", help="Keys are ROS 2 topics (rmw_zenoh).")] = False,
    domain: DomainOption = 0,
    ros2_distro: DistroOption = "jazzy",
    reliable: ReliableOption = False,
    zenoh_config: ConfigOption = None,
    port: PortOption = 7447,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Recordings as live cameras, at their own pace or faster; several at once."""
    from streamfeat.live.names import PlainNames, RosNames
    from streamfeat.live.network import Network
    from streamfeat.live.publish import PublishJob
    from streamfeat.stream.replay import parse_speed

    if len(sources) % 2:
        raise InputError("give each recording a key: publish ONE.mcap cam0/events TWO.mcap cam1/events")
    pairs = [(location_of(path), key) for path, key in zip(sources[::2], sources[1::2], strict=True)]
    for _, key in pairs:
        names = RosNames(key, domain, has_hashes(ros2_distro)) if ros2 else PlainNames(key)
    job = PublishJob(
        pairs,
        names,
        topic=topic,
        reading=reading,
        speed=parse_speed(speed),
        loop=loop,
        encoding=encoding,
        wait_s=wait,
        network=Network(zenoh_config, port, reliable),
    )
    print_assumptions(job.assumptions)
    with progress_bars(quiet=quiet) as report:
        job.run(report)
    print_result(job.result(), "published", as_json=as_json, command="publish")


@app.command(epilog="Example: streamfeat record 'robot/*/events' -o drive.mcap")
def record(
    output: Annotated[Path, typer.Option("--output", "-o", help="MCAP file to write.")],
    key: KeyArgument = None,
    compression: Annotated[
        str,
        typer.Option(help="Chunks: lz4, zstd or none.", autocompletion=completing("lz4", "zstd", "none")),
    ] = "lz4",
    chunk: Annotated[float, typer.Option(help="Seconds that a crash can cost.")] = 0.5,
    ros2: RosOption = None,
    domain: DomainOption = 0,
    reliable: ReliableOption = False,
    zenoh_config: ConfigOption = None,
    port: PortOption = 7447,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Live topics to MCAP, safe against a crash at any byte; see `streamfeat recover`."""
    from streamfeat.live.network import Network
    from streamfeat.live.record import RecordJob

    refuse_existing(output, overwrite=overwrite)
    job = RecordJob(
        names_of(key, ros2, domain),
        output,
        compression=compression,  # type: ignore[arg-type]
        chunk_s=chunk,
        overwrite=overwrite,
        network=Network(zenoh_config, port, reliable),
        console=err,
    )
    with progress_bars(quiet=quiet) as report:
        job.run(report)
    print_result(job.result(), "recorded", as_json=as_json, command="record")


@app.command(epilog="Example: streamfeat recover drive.mcap.part drive.mcap")
def recover(
    source: Annotated[
        AnyLocation,
        typer.Argument(metavar="IN", help="Damaged recording, or its URL.", parser=location_of),
    ],
    target: Annotated[Path, typer.Argument(metavar="OUT.mcap", help="Recording to write.")],
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Copy everything readable of a damaged recording into a new, intact one."""
    from streamfeat.recordings.writer import recover as recover_recording

    with progress_bars(quiet=quiet) as report:
        losses = recover_recording(source, target, overwrite=overwrite, report=report)
    result = {"written": str(target), "lost": sum(losses.counts.values()), "reasons": dict(losses.counts)}
    print_result(result, "recovered", as_json=as_json, command="recover")
    print_losses(losses)


@app.command(epilog="Example: streamfeat topics --json")
def topics(
    seconds: Annotated[float, typer.Option(help="How long to listen.")] = 1.0,
    zenoh_config: ConfigOption = None,
    port: PortOption = 7447,
    as_json: JsonOption = False,
) -> None:
    """Topics that events are published on, plain zenoh and ROS 2, and what they carry.

    Publishers are looked for, and then listened to for as long: type, encoding, resolution and rate.
    """
    from dataclasses import asdict

    from streamfeat.errors import printable
    from streamfeat.live.network import Network, find_topics
    from streamfeat.live.survey import hear_topics

    if not 0 <= seconds < 1e6:
        raise InputError(f"--seconds {seconds}: give a number from 0 on")
    with Network(zenoh_config, port).open() as session:
        found = find_topics(session, seconds)
        heard = hear_topics(session, found, seconds if found else 0)
    if as_json:
        rows = [asdict(topic.found) | asdict(topic) for topic in heard]
        for row in rows:
            del row["found"]
        print_json("topics", {"topics": rows})
        return
    for topic in heard:
        about = topic.found
        where = f"ROS 2, domain {about.domain}" if about.kind == "ros2" else "zenoh"
        size = f"{topic.resolution[1]}x{topic.resolution[0]}" if topic.resolution else ""
        rate = f"{topic.rate_hz:,.1f} messages/s, {topic.bytes_per_s / 1e6:,.2f} MB/s"
        carried = (topic.type, topic.encoding, size, rate) if topic.type else ("nothing was sent meanwhile",)
        parts = where, f"publishers: {about.publishers}", *map(printable, filter(None, carried))
        out.print(f"{escape(printable(about.name))}  [dim]{escape(', '.join(parts))}[/]", soft_wrap=True)
    if not heard:
        out.print("no topic with events was found")
