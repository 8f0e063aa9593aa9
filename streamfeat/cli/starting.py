"""Commands for a first look: demo, doctor.

Lives here: their arguments, and how their results are shown.
Not here: what they do (`demo`, `doctor`).
"""

import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from streamfeat.cli.program import (
    JsonOption,
    OverwriteOption,
    QuietOption,
    app,
    err,
    out,
    print_json,
    print_result,
)
from streamfeat.cli.progress import progress_bars
from streamfeat.errors import InputError
from streamfeat.work import interrupts

__all__ = ["demo", "doctor"]


@app.command(epilog="Example: streamfeat demo")
def demo(
    folder: Annotated[Path, typer.Option(help="Where everything is written.")] = Path("streamfeat-demo"),
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Simulate recordings of digits, learn features, train, and replay with a live picture.

    Takes up to a minute when kernels have to be compiled first; nothing is downloaded.
    """
    from streamfeat.demo.demo import FILES, Demo

    if there := [name for name in FILES if (folder / name).exists()]:
        if not overwrite:
            raise InputError(
                f"{folder}: holds {', '.join(there)} already; give --overwrite, or another --folder"
            )
        err.print(f"[yellow]replacing[/] {', '.join(there)} in {escape(str(folder))}", soft_wrap=True)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made: {error.strerror}; give another --folder") from error
    started = time.monotonic()
    interrupts.last_words(f"interrupted; {folder} holds what was done")
    try:
        with progress_bars(quiet=quiet) as report:
            job = Demo(folder, report)
            with job.compiling():
                simulated = job.simulate()
                encoder = job.learn()
                job.compile(encoder, None if quiet else err)
            classifier = job.fit(encoder)
        replayed = job.replay(encoder, classifier, None if quiet or as_json else out)
    except KeyboardInterrupt:
        err.print(f"[yellow]{escape(interrupts.take_last_words())}[/]", soft_wrap=True)
        raise typer.Exit(interrupts.INTERRUPTED) from None
    result = {
        "written": str(folder),
        "simulated": simulated,
        "features": encoder.n_features,
        **replayed,
        "seconds": round(time.monotonic() - started, 1),
    }
    if as_json:
        print_json("demo", result | {"next": job.commands()})
    else:
        print_result(result, "demonstrated", as_json=False, command="demo")
        out.print("\n[bold]try next[/]")
        for command in job.commands():
            typer.echo(command)  # as it is, for it is to be copied
    if job.interrupted:
        raise typer.Exit(130)


@app.command(epilog="Example: streamfeat doctor --json")
def doctor(as_json: JsonOption = False) -> None:
    """Versions, processor, threads, a second of work, and what is missing for which extra.

    The exit status is 1 where something keeps streamfeat from working as it should. Extras may be missing.
    """
    from streamfeat.cli.installation import examine

    with progress_bars() as report:
        found = examine(lambda step: report("looking", 0, 0, step))
    if as_json:
        print_json("doctor", found)
    else:
        print_result(_overview(found), "this machine", as_json=False)
        out.print()
        print_result(_extras(found), "extras", as_json=False)
        for problem in found["problems"]:
            err.print(f"[bold red]problem:[/] {escape(problem)}", soft_wrap=True)
        if not found["problems"]:
            out.print("\n[green]all is well[/]")
    raise typer.Exit(1 if found["problems"] else 0)


def _overview(found: dict[str, Any]) -> dict[str, Any]:
    machine, speed, kernels = found["machine"], found["speed"], found["kernels"]
    stolen = speed["taken_by_others"]
    return {
        "streamfeat": machine["streamfeat"],
        "python": f"{machine['python']}, {machine['system']}",
        "processor": f"{machine['cpu']}, {machine['cores']} cores",
        "vectors": ", ".join(found["vectors"]) or "none",
        "threads": f"{found['threads']['numba']}, layer {found['threads']['layer']}",
        **{name: about["installed"] or "missing" for name, about in found["required"].items()},
        "kernels": f"of sources {kernels['digest']}, "
        + (f"kept in {kernels['folder']}" if kernels["cached"] else "kept nowhere"),
        "first_use": f"{kernels['first_use_s']} s",
        "exact": "yes: stream and offline features have the same bits" if found["exact"] else "no",
        "feeding": f"{speed['events_per_s']:,} events a second",
        "following": f"{speed['event_us']} us an event, {speed['filters']} filters",
        "disturbed": "unknown"
        if stolen is None
        else f"{stolen:.0%} of processor time went to other machines",
    }


def _extras(found: dict[str, Any]) -> dict[str, str]:
    lines = {}
    for extra, about in found["extras"].items():
        missing = ", ".join(about["missing"])
        state = f"missing {missing}; pip install 'streamfeat[{extra}]'" if missing else "complete"
        lines[extra] = f"{about['for']}: {state}"
    return lines
