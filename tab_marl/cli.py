"""The command line: ``tab-marl evaluate | train | field | watch | report | zoo``.

Heavy imports happen inside the commands, so that ``--help`` answers at once.
"""

from __future__ import annotations

import os
import shlex
import signal
import sys
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from tab_marl.evaluation.errors import UserError

app = typer.Typer(
    name="tab-marl",
    help="Task-aware behaviour fields and POMCP against learned adversaries.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

EXIT_USER_ERROR = 2
EXIT_BUG = 70
EXIT_INTERRUPTED = 130

Out = Annotated[Path, typer.Option("--out", "-o", help="Folder for the episodes and the report.")]


def _names(text: str | None) -> tuple[str, ...] | None:
    """Comma-separated names; None if the option was not given."""
    return None if text is None else tuple(part.strip() for part in text.split(",") if part.strip())


@app.command()
def evaluate(
    missions: Annotated[str | None, typer.Option(help="Comma-separated, of M1 to M5.")] = None,
    families: Annotated[str | None, typer.Option(help="Comma-separated: point, perimeter, ambiguous.")] = None,
    planners: Annotated[str | None, typer.Option(help="Comma-separated planner names.")] = None,
    adversaries: Annotated[str | None, typer.Option(help="Comma-separated zoo policies; default: all in turn.")] = None,
    episodes: Annotated[int | None, typer.Option(help="Episodes per mission, family and planner.")] = None,
    seed: Annotated[int | None, typer.Option(help="Base seed of tasks, adversaries and noise.")] = None,
    slack: Annotated[
        float | None, typer.Option(help="Allowed time over shortest time; default: drawn per task.")
    ] = None,
    workers: Annotated[int | None, typer.Option(help="Processes; default: one per core.")] = None,
    replays: Annotated[int | None, typer.Option(help="Animated replays in the report.")] = None,
    out: Out = Path("runs/evaluation"),
    config: Annotated[Path | None, typer.Option(help="TOML file with these settings; options override it.")] = None,
    preset: Annotated[str | None, typer.Option(help="demo (minutes) or paper (150 episodes each).")] = None,
) -> None:
    """Play missions x families x planners against the zoo; print the tables and write an HTML report.

    Episodes are stored as they end: the same command continues an interrupted run.
    """
    from rich.console import Console

    from tab_marl.evaluation.settings import build_settings

    settings = build_settings(
        preset,
        config,
        {
            "missions": _names(missions),
            "families": _names(families),
            "planners": _names(planners),
            "adversaries": _names(adversaries),
            "episodes": episodes,
            "seed": seed,
            "slack": slack,
            "workers": workers,
            "replays": replays,
        },
    )
    from tab_marl.evaluation.episode import play_job
    from tab_marl.evaluation.evaluate import play_missing, prepare
    from tab_marl.evaluation.store import Store

    notes = Console(stderr=True)
    with Store.create(out) as store:
        experiment = prepare(settings)
        play_missing(experiment, store, play_job, notes, f"tab-marl {shlex.join(sys.argv[1:])}")
        _present(store, experiment.key, out, settings.replays)


@app.command()
def report(
    out: Out = Path("runs/evaluation"),
    key: Annotated[str | None, typer.Option("--settings", help="Settings key, if the folder holds several.")] = None,
    replays: Annotated[int | None, typer.Option(help="Animated replays; default: as evaluated.")] = None,
) -> None:
    """Print the tables of stored episodes again and rewrite their report."""
    from tab_marl.evaluation.store import Store

    with Store.open(out) as store:
        known = [s for s in store.settings() if s.rows]
        if not known:
            raise UserError(f"{out}: no episode is stored here yet; run tab-marl evaluate")
        matching = [s for s in known if key is None or s.key.startswith(key)]
        if not matching:
            raise UserError(f"no settings with key {key!r} in {store.path}; known: {', '.join(s.key for s in known)}")
        if key is None and len(known) > 1:
            print(f"settings {known[0].key} (latest of {len(known)}; --settings chooses another)", file=sys.stderr)
        _present(store, matching[0].key, store.path.parent, replays)


def _present(store: object, key: str, folder: Path, replays: int | None) -> None:
    raise NotImplementedError


def main() -> NoReturn:
    """Run the command line; every error of the user's is one line on stderr and a status other than 0."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # a polite kill ends a run as Ctrl-C does
    try:
        status = app(standalone_mode=False)
    except (KeyboardInterrupt, typer.Abort):
        _fail("interrupted", EXIT_INTERRUPTED)
    except BrokenPipeError:
        # The reader of our output has gone; keep the interpreter from complaining when it flushes.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except Exception as error:
        message = user_message(error)
        if message is not None:
            _fail(message, EXIT_USER_ERROR)
        if os.environ.get("TAB_MARL_TRACEBACK"):
            raise
        _fail(
            f"internal error: {type(error).__name__}: {error} (TAB_MARL_TRACEBACK=1 shows where)".replace("\n", " "),
            EXIT_BUG,
        )
    sys.exit(status if isinstance(status, int) else 0)


def user_message(error: Exception) -> str | None:
    """One line for an error that the user can mend; None for one that is ours."""
    import sqlite3

    if isinstance(error, UserError):
        return str(error)
    if hasattr(error, "format_message"):  # the command line parser's own errors
        return " ".join(str(error.format_message()).split())
    if isinstance(error, OSError):
        name = f"{error.filename}: " if error.filename else ""
        return f"{name}{error.strerror or error}"
    if isinstance(error, sqlite3.OperationalError):
        return f"the store cannot be used: {error}"
    if isinstance(error, MemoryError):
        return "out of memory: use fewer --workers"
    return None


def _fail(message: str, status: int) -> NoReturn:
    print(f"tab-marl: {message}", file=sys.stderr)
    sys.exit(status)


if __name__ == "__main__":
    main()
