"""The command line: ``tab-marl evaluate | train | field | watch | report | zoo``.

Heavy imports happen inside the commands, so that ``--help`` answers at once.
"""

from __future__ import annotations

import os
import shlex
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from tab_marl.evaluation.errors import UserError, user_message

if TYPE_CHECKING:
    from rich.console import Console

    from tab_marl.agents.policies.cards import Split
    from tab_marl.evaluation.store import Store, StoredSettings

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


def _use_zoo(folder: Path | None) -> Path | None:
    """Take a folder as the user's zoo, here and in every process started from here."""
    if folder is not None:
        os.environ["TAB_MARL_ZOO"] = str(folder.expanduser().resolve())
    return folder


UserZoo = Annotated[
    Path | None,
    typer.Option(
        "--zoo", callback=_use_zoo, help="Folder of your own policies; default: $TAB_MARL_ZOO, or your data folder."
    ),
]


def _names(text: str | None) -> tuple[str, ...] | None:
    """Comma-separated names; None if the option was not given."""
    return None if text is None else tuple(part.strip() for part in text.split(",") if part.strip())


@app.command()
def evaluate(
    missions: Annotated[str | None, typer.Option(help="Comma-separated, of M1 to M5.")] = None,
    families: Annotated[str | None, typer.Option(help="Comma-separated: point, perimeter, ambiguous.")] = None,
    planners: Annotated[str | None, typer.Option(help="Comma-separated planner names.")] = None,
    adversaries: Annotated[
        str | None,
        typer.Option(
            help="Comma-separated: policies of the zoo, folders of policies, scripted, or a split (development, final, "
            "all); default: final."
        ),
    ] = None,
    mix_splits: Annotated[
        bool | None, typer.Option("--mix-splits", help="Let policies for development and final ones share a table.")
    ] = None,
    episodes: Annotated[int | None, typer.Option(help="Episodes per mission, family and planner.")] = None,
    seed: Annotated[int | None, typer.Option(help="Base seed of tasks, adversaries and noise.")] = None,
    slack: Annotated[
        float | None, typer.Option(help="Allowed time over shortest time; default: drawn per task.")
    ] = None,
    workers: Annotated[int | None, typer.Option(help="Processes; default: one per core.")] = None,
    engine: Annotated[str, typer.Option(help="What plays: local (processes of this machine) or ray.")] = "local",
    address: Annotated[
        str | None, typer.Option(help="With --engine ray: auto, ray://HOST:10001, or none for a Ray of its own.")
    ] = None,
    replays: Annotated[int | None, typer.Option(help="Animated replays in the report.")] = None,
    out: Out = Path("runs/evaluation"),
    config: Annotated[Path | None, typer.Option(help="TOML file with these settings; options override it.")] = None,
    preset: Annotated[str | None, typer.Option(help="demo (minutes) or paper (150 episodes each).")] = None,
    zoo: UserZoo = None,
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="Play again what is stored as failed.")] = False,
    half_width: Annotated[
        float, typer.Option(help="Print how many episodes bring an ATCR's interval down to +- this, in points.")
    ] = 5.0,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print what a run would take, and stop.")] = False,
) -> None:
    """Play missions x families x planners against the zoo; print the tables and write an HTML report.

    Episodes are stored as they end: the same command continues an interrupted run.
    """
    from tab_marl.evaluation.settings import build_settings

    settings = build_settings(
        preset,
        config,
        {
            "missions": _names(missions),
            "families": _names(families),
            "planners": _names(planners),
            "adversaries": _names(adversaries),
            "mix_splits": mix_splits,
            "episodes": episodes,
            "seed": seed,
            "slack": slack,
            "workers": workers,
            "replays": replays,
        },
    )
    from tab_marl.evaluation.evaluate import Manner, evaluate_and_present

    manner = Manner(engine, address, half_width, dry_run, retry_failed)
    evaluate_and_present(settings, out, manner, f"tab-marl {shlex.join(sys.argv[1:])}")


@app.command()
def export(
    out: Out = Path("runs/evaluation"),
    kind: Annotated[str, typer.Option("--format", help="csv, or parquet (needs pyarrow).")] = "csv",
    to: Annotated[Path | None, typer.Option(help="The file; default: OUT/episodes.csv or .parquet.")] = None,
    key: Annotated[str | None, typer.Option("--settings", help="Settings key, if the folder holds several.")] = None,
) -> None:
    """Write stored episodes to one file for other programs, a row per episode."""
    from tab_marl.evaluation.console import notes_console
    from tab_marl.evaluation.export import check_format
    from tab_marl.evaluation.export import export as write
    from tab_marl.evaluation.store import Store

    check_format(kind)
    with Store.open(out) as store:
        stored = _stored(store, out, key, notes_console())
        path = to or store.path.parent / f"episodes.{kind}"
        count, checksum = write(store, stored.key, kind, path)
        print(f"{count} episodes: {path}\nsha256 of what settings and seeds decide: {checksum}")


def _stored(store: Store, out: Path, key: str | None, notes: Console) -> StoredSettings:
    """The settings whose key begins so, or the latest ones that have rows."""
    known = [s for s in store.settings() if s.rows]
    if not known:
        raise UserError(f"{out}: no episode is stored here yet; run tab-marl evaluate")
    matching = [s for s in known if key is None or s.key.startswith(key)]
    if not matching:
        raise UserError(f"no settings with key {key!r} in {store.path}; known: {', '.join(s.key for s in known)}")
    if key is None and len(known) > 1:
        notes.print(f"settings {known[0].key}, the latest of {len(known)}; --settings chooses another", highlight=False)
    return matching[0]


@app.command()
def report(
    out: Out = Path("runs/evaluation"),
    key: Annotated[str | None, typer.Option("--settings", help="Settings key, if the folder holds several.")] = None,
    replays: Annotated[int | None, typer.Option(min=0, max=30, help="Animated replays; default: as evaluated.")] = None,
    tables: Annotated[str | None, typer.Option(help="Also tables for papers, in OUT/tables: md, tex.")] = None,
    figures: Annotated[str | None, typer.Option(help="Also figures, in OUT/figures: svg, pdf, png.")] = None,
    films: Annotated[str | None, typer.Option(help="Also a film of every replay, in OUT/films: gif, mp4.")] = None,
) -> None:
    """Print the tables of stored episodes again and rewrite their report; also tables, figures and films for papers."""
    from tab_marl.evaluation.console import notes_console
    from tab_marl.evaluation.report.present import Wanted, present
    from tab_marl.evaluation.store import Store

    wanted = Wanted(_names(tables) or (), _names(figures) or (), _names(films) or ())

    notes = notes_console()
    with Store.open(out) as store:
        stored = _stored(store, out, key, notes)
        present(store, stored, store.path.parent, replays, notes, wanted)


@app.command()
def field(
    mission: Annotated[str, typer.Argument(help='In English: "Reach Checkpoint A within 16s".')],
    scenario: Annotated[str, typer.Option(help="Name of a scenario.")] = "lab",
    preset: Annotated[str, typer.Option(help="default, or paper (the literal field).")] = "default",
    out: Annotated[Path, typer.Option("--out", "-o", help="The picture: .png, .svg or .pdf.")] = Path("field.png"),
    animation: Annotated[Path | None, typer.Option(help="Also a film of the occupancy: .gif or .mp4.")] = None,
    answers: Annotated[Path | None, typer.Option(help="Also the numbers: .json (all) or .csv (by tick).")] = None,
    save: Annotated[Path | None, typer.Option(help="Also the field itself: .npz, for tab_marl.TabField.load.")] = None,
    completes: Annotated[float | None, typer.Option(help="Probability that the mission is completed.")] = None,
    passes: Annotated[
        list[str] | None, typer.Option(help='Soft constraint "PLACE=PROBABILITY"; may be repeated.')
    ] = None,
    start: Annotated[
        str, typer.Option(help='scenario; nearer: moved if the mission is impossible from there; or metres "x,y".')
    ] = "nearer",
) -> None:
    """Solve the TAB-Field of a mission, print what it says and draw it."""
    from tab_marl.evaluation.field_command import FieldRequest, show_field

    _announce_first_use("field")
    print(
        show_field(
            FieldRequest(
                mission, scenario, preset, out, animation, save, answers, completes, tuple(passes or ()), start
            )
        )
    )


@app.command()
def watch(
    mission: Annotated[str, typer.Option(help="M1 to M5, or a mission in English (with --scenario).")] = "M1",
    family: Annotated[str, typer.Option(help="point, perimeter or ambiguous, on random maps.")] = "ambiguous",
    scenario: Annotated[str, typer.Option(help="random, or the name of a scenario.")] = "random",
    planner: Annotated[str, typer.Option(help="Who drives the ego.")] = "TAB-POMCP",
    adversary: Annotated[
        str | None,
        typer.Option(help="A policy of the zoo, a folder, or scripted; default: the first of the final split."),
    ] = None,
    zoo: UserZoo = None,
    seed: Annotated[int, typer.Option(min=0, help="Decides map, starts and noise.")] = 0,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="A .gif, .mp4 or folder of PNGs instead of a window.")
    ] = None,
) -> None:
    """Play one episode and show it, with the planner's belief over the map."""
    from tab_marl.evaluation.single import watch_episode

    _announce_first_use()
    print(watch_episode(mission, family, scenario, planner, adversary, seed, out))


@app.command()
def train(
    population: Annotated[
        Path | None,
        typer.Argument(
            help="TOML file of a population, or one of ours: shipped, algorithms; without it one policy is trained."
        ),
    ] = None,
    style: Annotated[
        str | None,
        typer.Option(help="Of one policy: direct, side, via, camera-shy, late, wander, fickle, contrary, habits."),
    ] = None,
    algorithm: Annotated[str | None, typer.Option(help="Of one policy: ppo, a2c, sac, td3, tqc, ppo_lstm.")] = None,
    config: Annotated[Path | None, typer.Option(help="Of one policy: TOML file with training settings.")] = None,
    steps: Annotated[int | None, typer.Option(help="Control steps over all robots.")] = None,
    seed: Annotated[int | None, typer.Option(help="Of initial weights, tasks and exploration.")] = None,
    name: Annotated[str | None, typer.Option(help="Of the policy; default: the style's.")] = None,
    only: Annotated[str | None, typer.Option(help="Of a population: comma-separated names of members.")] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Of a population: processes; default: one per core.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder of the runs; default: runs/train/NAME.")
    ] = None,
) -> None:
    """Train adversaries: a population from a file, or one policy. The same command continues what was interrupted."""
    from tab_marl.evaluation.console import notes_console
    from tab_marl.evaluation.train_command import train_many, train_one

    if population is None:
        if only is not None or workers is not None:
            raise UserError("--only and --workers are for a population: give its file")
        _announce_first_use()
        changes = {"steps": steps, "seed": seed, "name": name}
        train_one(style, algorithm, config, changes, out, notes_console())
        return
    alone = {"--style": style, "--algorithm": algorithm, "--config": config, "--seed": seed, "--name": name}
    given = [option for option, value in alone.items() if value is not None]
    if given:
        raise UserError(f"{given[0]} is for a single policy: {population} says it for each of its members")
    _announce_first_use()
    if not train_many(population, _names(only), workers, steps, out, notes_console()):
        raise typer.Exit(1)


zoo_app = typer.Typer(help="Trained adversaries: those that ship, and your own.", no_args_is_help=True)
app.add_typer(zoo_app, name="zoo")


@zoo_app.command("list")
def zoo_list(
    split: Annotated[str | None, typer.Option(help="development or final; default: both.")] = None,
    zoo: UserZoo = None,
) -> None:
    """Every policy: algorithm, style, split, success, and which figure its style moved."""
    from tab_marl.evaluation.zoo_view import zoo_table

    zoo_table(None if split is None else _split(split))


@zoo_app.command("show")
def zoo_show(
    name: Annotated[str, typer.Argument(help="Name of a policy, or its folder.")], zoo: UserZoo = None
) -> None:
    """Everything on the card of a policy."""
    from tab_marl.evaluation.zoo_view import zoo_card

    print(zoo_card(name))


@zoo_app.command("add")
def zoo_add(
    model: Annotated[Path, typer.Argument(help="The .zip that model.save of stable-baselines3 or sb3-contrib wrote.")],
    name: Annotated[str, typer.Option(help="What to call the policy.")],
    style: Annotated[str, typer.Option(help="The adversary_style of the environment it was trained in.")] = "direct",
    missions: Annotated[str, typer.Option(help="Comma-separated mission types that it claims.")] = "M1,M2,M3,M4,M5",
    split: Annotated[str, typer.Option(help="development or final.")] = "development",
    algorithm: Annotated[str, typer.Option(help="Default: what the file says.")] = "",
    author: Annotated[str, typer.Option(help="Whose it is.")] = "",
    description: Annotated[str, typer.Option(help="What it is, in a line.")] = "",
    command: Annotated[str, typer.Option(help="What trains it again.")] = "",
    normalisation: Annotated[
        Path | None, typer.Option(help=".npz with mean and var of VecNormalize, if it was trained under that.")
    ] = None,
    episodes: Annotated[int, typer.Option(min=1, help="Held-out tasks per mission type that it is measured on.")] = 40,
    anyway: Annotated[bool, typer.Option("--anyway", help="Add it below 90 %; its card will say so.")] = False,
    zoo: UserZoo = None,
) -> None:
    """Let a model trained on our environments join your zoo: read as plain weights, measured, then written.

    Refused if it completes less than 90 % of a mission type that it claims.
    """
    from tab_marl.agents.policies.joining import Joining
    from tab_marl.evaluation.zoo_view import add_to_zoo

    _announce_first_use()
    joining = Joining(
        name, style, _names(missions) or (), _split(split), algorithm, author, description, command, normalisation
    )
    print(add_to_zoo(model, joining, anyway, episodes))


@zoo_app.command("verify")
def zoo_verify(
    episodes: Annotated[int, typer.Option(min=1, help="Fresh held-out tasks per mission type claimed.")] = 10,
    name: Annotated[str | None, typer.Argument(help="Name of a policy, or its folder; default: all.")] = None,
    zoo: UserZoo = None,
) -> None:
    """Check files and replay in pymunk what the cards claim; fails if a policy falls below 90 % beyond doubt."""
    from tab_marl.evaluation.zoo_view import verify_zoo

    _announce_first_use()
    raise typer.Exit(0 if verify_zoo(name, episodes) else 1)


def _split(name: str) -> Split:
    from tab_marl.agents.policies.cards import SPLITS
    from tab_marl.evaluation.errors import require_known

    (right,) = require_known("split", (name,), SPLITS)
    return next(split for split in SPLITS if split == right)


def _announce_first_use(part: str = "planning") -> None:
    from tab_marl.evaluation.evaluate import FIRST_USE, first_use

    if first_use(part):
        print(FIRST_USE, file=sys.stderr)


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


def _fail(message: str, status: int) -> NoReturn:
    print(f"tab-marl: {message}", file=sys.stderr)
    sys.exit(status)


if __name__ == "__main__":
    main()
