"""Write docs/environments/NAME.md for every environment from the code itself: ids, spaces, rewards, ends, arguments.

python scripts/environment_pages.py            # tests/docs fails while a page differs from what this writes
"""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pettingzoo

import tab_marl  # noqa: F401, registers the environments
from tab_marl.envs import adversary_observation, reward, single_agent
from tab_marl.envs.actions import SPEEDS, TURNS
from tab_marl.envs.ego_observation import Row, ego_rows
from tab_marl.envs.registration import ENVIRONMENTS, Environment
from tab_marl.envs.team import TeamEnv
from tab_marl.world import scenario as world

OUT = Path(__file__).resolve().parent.parent / "docs" / "environments"

ROWS: tuple[tuple[str, str, str], ...] = (
    (r"(.*)\bx", "{who} centre, from the left wall", "m"),
    (r"(.*)\by", "{who} centre, from the lower wall", "m"),
    (r"(.*)\bcos", "cosine of {who} heading", ""),
    (r"(.*)\bsin", "sine of {who} heading", ""),
    (r"(.*)\bv", "{who} speed along its heading (below 0 when pushed)", "m/s"),
    (r"(.*)\bw", "{who} turn rate, anticlockwise", "rad/s"),
    (r"elapsed", "time since the start", "s"),
    (r"left", "time until the horizon", "s"),
    (r"seen( \d+)?", "1 while a camera sees the adversary, and {always}", ""),
    (r"adversary \d+ in play", "1 until it is intercepted or, where that ends it, its mission is over", ""),
    (r"lidar (\d+)", "free distance along ray {ray}, anticlockwise from the heading", "m"),
    (r"mission( \d+)?", "the mission: 0 under way, 1 completed, -1 failed", ""),
)
"""Name of a row, what it means, its unit."""

ARGUMENTS = {
    "task": "a `Task`, or a function of a NumPy generator that draws one; goes before `mission`, `scenario`, `family`",
    "mission": "an id (M1 .. M5, U5), an English text, a `Mission`, or \"any\"; in teams also one per adversary",
    "scenario": "a preset's name, a `Scenario`, or \"random\": map, starts and deadlines drawn at every reset",
    "family": "of drawn tasks: point, ambiguous or perimeter",
    "sampled": "draw goals, starts and deadlines on a fixed map",
    "difficulty": "0..1 of drawn tasks; None: as they come. `set_difficulty` changes it",
    "curriculum": "a `Curriculum`: what difficulty means; None: the default one",
    "ego_task": "interception, avoidance or surveillance; None: the scenario's",
    "adversary_sees_ego_metres": "within this range and in free sight the adversary notices the ego; None: the scenario's; 0: blind",
    "adversary_style": "a `Style` or its name: how the routes that the adversary observes are bent",
    "render_mode": "None, \"rgb_array\" or \"human\"",
    "end_on_completion": "the episode also ends when the mission is completed or fails",
    "full_observation": "the ego always sees the adversary",
    "max_cycles": "the most control steps, if fewer than the horizon's",
    "adversary_rewards": '"plain", "shaped", or an `AdversaryRewards` (below); None: plain',
    "show_lidar": "draw the ego's lidar",
    "actions": "\"continuous\" or \"discrete\"",
    "egos": "how many egos, 1..16",
    "adversaries": "how many adversaries, 1..16",
    "opponent": "who plays the other side: a scripted player's name, a zoo policy's or a planner's, a model, or a function of observations",
    "teammate": "who plays the rest of the learner's own side",
}  # fmt: skip
"""What each argument of an environment means."""

ENDS = {
    "interception": "**terminated** when the centres are within {meeting:g} m of each other (checked at every physics step)",
    "avoidance": "**terminated** when the centres are within {meeting:g} m of each other, or the ego's centre is in its goal",
    "surveillance": "never terminated by the robots: meeting does nothing",
}
VERSIONS = {0: "first version (tab_marl 0.1)"}
TERMS = {
    "interception": ("interception", "mission_completed"),
    "avoidance": ("encounter", "arrival"),
    "surveillance": ("watched",),
}
COMMON_TERMS = ("per_step", "control", "collision")


def page(environment: Environment) -> str:
    """The page of one environment."""
    env: Any = pettingzoo.make("parallel", environment.pettingzoo_id).unwrapped
    env.reset(seed=0)
    task = getattr(env, "ego_task", "interception")
    parts = [
        f"# {environment.name}",
        environment.meaning,
        f"![An episode](../images/environments/{environment.name}.webp)",
        _usage(environment),
        _facts(environment, env),
        "## Actions",
        _actions(env),
    ]
    scenario = env._shape_of
    for agent in _distinct_agents(env):
        side = "ego" if agent.startswith("ego") else "adversary"
        parts += [f"## What the {side} observes", _observation(env, agent, scenario)]
    parts += ["## State for centralised critics", "`env.state()`, the whole truth:", _table_of_rows(_state_layout(env))]
    parts += ["## Rewards", _rewards(env, task, scenario), "## Ends", _ends(env, task, scenario)]
    parts += [
        "## Arguments",
        _arguments(environment, type(env)),
        "## A still",
        f"![A moment](../images/environments/{environment.name}.png)",
    ]
    parts += ["## Version history", _table(("version", "change"), [(f"v{v}", text) for v, text in VERSIONS.items()])]
    return "\n\n".join(parts) + "\n"


def _usage(environment: Environment) -> str:
    lines = ["import gymnasium", "import pettingzoo", "import tab_marl", ""]
    lines += [f'env = pettingzoo.make("parallel", "{environment.pettingzoo_id}")  # or "aec"']
    for name, side in environment.gymnasium_ids.items():
        lines += [f'{side} = gymnasium.make("{name}")']
    return "```python\n" + "\n".join(lines) + "\n```"


def _facts(environment: Environment, env: Any) -> str:
    scenario = env._shape_of
    rows = [
        ("PettingZoo id", f"`{environment.pettingzoo_id}`"),
        ("Gymnasium ids", ", ".join(f"`{name}`" for name in environment.gymnasium_ids)),
        ("the id fixes", ", ".join(f"`{k}={v!r}`" for k, v in environment.arguments.items()) or "nothing"),
        ("agents", ", ".join(f"`{agent}`" for agent in env.possible_agents)),
        (
            "arena",
            f"{scenario.width_metres:g} x {scenario.height_metres:g} m"
            + (", at most" if "random" in str(environment.arguments) else ""),
        ),
        (
            "one step",
            f"{1 / scenario.control_hertz:g} s, {scenario.physics_hertz // scenario.control_hertz} physics steps",
        ),
        ("state shape", f"{env.state_space.shape}"),
        ("seeds", "`reset(seed=...)`; same seed, options and actions: same episode"),
    ]
    return _table(("what", "here"), rows)


def _actions(env: Any) -> str:
    ego = env._shape_of.ego
    if env.action_kind == "discrete":
        rows = [
            (str(i * len(TURNS) + j), f"{speed:g}", f"{turn:g}")
            for i, speed in enumerate(SPEEDS)
            for j, turn in enumerate(TURNS)
        ]
        return (
            f"`{env.action_space('ego_0')}`, the same for every agent, as shares of the top speed and turn rate (clockwise is negative):\n\n"
            + _table(("action", "speed", "turn rate"), rows)
        )
    rows = [
        ("0", f"speed: -1 stands still, 1 is the top speed ({ego.max_speed:g} m/s)", "(v / v_max) 2 - 1", "-1", "1"),
        ("1", f"turn rate: 1 is {ego.max_turn_rate:g} rad/s anticlockwise, -1 clockwise", "w / w_max", "-1", "1"),
    ]
    return (
        "`Box(-1, 1, (2,), float32)`, the same for every agent. Values beyond the bounds, NaN and infinities are refused.\n\n"
        + _table(("index", "meaning", "unit", "min", "max"), rows)
    )


def _distinct_agents(env: Any) -> list[str]:
    return [agent for agent in env.possible_agents if agent.endswith("_0")]


def _observation(env: Any, agent: str, scenario: world.Scenario) -> str:
    if agent.startswith("adversary"):
        return (
            "Its own mission, time and route, and the ego while it notices it; no map coordinates. All zero once its mission "
            "is over.\n\n" + _table(("index", "name", "meaning", "unit", "min", "max"), adversary_table())
        )
    egos = sum(a.startswith("ego") for a in env.possible_agents)
    adversaries = sum(a.startswith("adversary") for a in env.possible_agents)
    return "Its own state exactly, the adversary only under a camera (zeros otherwise).\n\n" + _table_of_rows(
        ego_rows(scenario, egos, adversaries), scenario.ego_task
    )


def adversary_table() -> list[tuple[str, ...]]:
    """Index, name, meaning, unit, min, max, from the layout's own description and bounds."""
    low, high = adversary_observation.observation_bounds()
    document = adversary_observation.__doc__ or ""
    found: list[list[str]] = []
    for line in document.split("=====\n")[2].splitlines():
        match = re.match(r"(\d+(?:-\d+)?)\s+(.+?)\s{2,}(.*)", line)
        if match:
            found.append([*match.groups()])
        elif found and line.startswith("      "):
            found[-1][2] += " " + line.strip()
    rows: list[tuple[str, ...]] = []
    for index, name, meaning in found:
        first, _, last = index.partition("-")
        for i in range(int(first), int(last or first) + 1):
            rows.append((str(i), name, meaning, "scaled", f"{low[i]:g}", f"{high[i]:g}"))
    return _merged(rows)


def _merged(rows: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Successive rows that differ in their index alone, as one."""
    merged: list[tuple[str, ...]] = []
    for row in rows:
        if merged and merged[-1][1:] == row[1:]:
            merged[-1] = (f"{merged[-1][0].split(' to ')[0]} to {row[0]}", *row[1:])
        else:
            merged.append(row)
    return merged


def _table_of_rows(rows: Sequence[Row], ego_task: str = "interception") -> str:
    lines = []
    for index, row in enumerate(rows):
        meaning, unit = row_meaning(row.name, ego_task)
        lines.append((str(index), row.name, meaning, unit, f"{row.low:g}", f"{row.high:g}"))
    lidar = [line for line in lines if line[1].startswith("lidar")]
    kept = [line for line in lines if not line[1].startswith("lidar")]
    if lidar:
        first, last = lidar[0], lidar[-1]
        meaning = f"free distance along {len(lidar)} rays, anticlockwise, the first along the heading"
        kept.append((f"{first[0]} to {last[0]}", f"{first[1]} .. {last[1].split()[-1]}", meaning, *first[3:]))
    return _table(("index", "name", "meaning", "unit", "min", "max"), kept)


def row_meaning(name: str, ego_task: str = "interception") -> tuple[str, str]:
    """(meaning, unit) of a row. Raises KeyError for a name that is not described."""
    for pattern, meaning, unit in ROWS:
        match = re.fullmatch(pattern, name)
        if match:
            owner = (match.group(1) or "").strip() if match.groups() else ""
            who = f"the {owner}'s" if owner else "own"
            always = "under `full_observation`" + (
                ", and while the ego watches it" if ego_task == "surveillance" else ""
            )
            return meaning.format(who=who, ray=owner, always=always), unit
    raise KeyError(name)


def _state_layout(env: Any) -> Sequence[Row]:
    if isinstance(env, TeamEnv):
        from tab_marl.envs.team import state_rows

        return state_rows(env._shape_of, len(env.ego_agents), len(env.adversary_agents))
    from tab_marl.envs.intercept import _state_rows

    return _state_rows(env._shape_of)


def field_docs(owner: type) -> dict[str, str]:
    """The docstring below each field of a dataclass, as one line."""
    body = ast.parse(inspect.cleandoc(inspect.getsource(owner))).body[0]
    assert isinstance(body, ast.ClassDef)
    found: dict[str, str] = {}
    for before, node in zip(body.body, body.body[1:], strict=False):
        named = isinstance(before, ast.AnnAssign) and isinstance(before.target, ast.Name)
        if named and isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            found[before.target.id] = " ".join(str(node.value.value).split())  # type: ignore[union-attr]
    return found


def _rewards(env: Any, task: str, scenario: world.Scenario) -> str:
    docs = {"collision": "Each time it starts touching a wall or an obstacle.", **field_docs(world.Rewards)}
    terms = [
        (t, f"{getattr(scenario.rewards, t):g}", docs[t].split(": ", 1)[-1]) for t in (*COMMON_TERMS, *TERMS[task])
    ]
    theirs = field_docs(reward.AdversaryRewards)
    prices = [(t, f"{getattr(reward.PLAIN, t):g}", f"{getattr(reward.SHAPED, t):g}", theirs[t]) for t in theirs]
    columns = ("term", '"plain"', '"shaped"', "when")
    ticks = f"One time step of `Scenario.step_seconds` is {scenario.step_seconds:g} s; a control step of {1 / scenario.control_hertz:g} s is charged its share."
    note = "" if task == "interception" else " In this ego task meeting the ego costs it nothing."
    team = (
        "\n\nA team of egos is paid together for interceptions and completions; time, control and collisions are each one's own."
        if isinstance(env, TeamEnv)
        else ""
    )
    return (
        f"The ego's (`Scenario.rewards`):\n\n{_table(('term', 'price', 'when'), terms)}\n\n{ticks}{team}\n\n"
        f"The adversary's (`adversary_rewards`):{note}\n\n{_table(columns, prices)}"
    )


def _ends(env: Any, task: str, scenario: world.Scenario) -> str:
    lines = [f"- {ENDS[task].format(meeting=scenario.interception_metres)};"]
    if isinstance(env, TeamEnv):
        lines = [
            f"- an adversary is **terminated** when an ego's centre is within {scenario.interception_metres:g} m of its own, and leaves;",
            "- the egos are **terminated** when no adversary is left in play;",
        ]
    lines += ["- with `end_on_completion` also **terminated** when the mission is completed or fails;"]
    steps = round(scenario.horizon_seconds * scenario.control_hertz)
    lines += [
        f"- **truncated** at the horizon, {scenario.horizon_seconds:g} s ({steps} steps) here, or after `max_cycles` steps."
    ]
    return (
        "\n".join(lines)
        + "\n\nThe single-agent views set `end_on_completion`, unless the ego's task is another than interception."
    )


def _arguments(environment: Environment, kind: type) -> str:
    rows = []
    for name, parameter in inspect.signature(kind).parameters.items():
        default = environment.arguments.get(name, parameter.default)
        rows.append((f"`{name}`", f"`{default!r}`", ARGUMENTS[name]))
    views = [name for name in ("opponent", "teammate")] if environment.views else []
    text = _table(("argument", "here", "meaning"), rows)
    if views:
        defaults = {
            side: inspect.signature(make).parameters["opponent"].default
            for side, make in (("ego", single_agent.ego_env), ("adversary", single_agent.adversary_env))
        }
        sides = set(environment.gymnasium_ids.values())
        shown = ", ".join(f"{defaults[s]!r} when the {s} learns" for s in ("ego", "adversary") if s in sides)
        text += "\n\nThe Gymnasium views also take:\n\n" + _table(
            ("argument", "here", "meaning"),
            [("`opponent`", shown, ARGUMENTS["opponent"]), ("`teammate`", "`None`", ARGUMENTS["teammate"])],
        )
    return text


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join(lines)


def index() -> str:
    """The overview of all environments."""
    rows = [
        (f"[{e.name}]({e.name}.md)", e.meaning, ", ".join(f"`{name}`" for name in e.gymnasium_ids))
        for e in ENVIRONMENTS
    ]
    return f"""# Environments

Two differential-drive robots in a walled arena. The **adversary** carries out a mission; the **ego** intercepts it, or
avoids or watches it, and sees it only under the cameras of checkpoints. Bodies are TurtleBot3 Burgers in pymunk at 100 Hz;
agents act at 10 Hz. Each environment is registered with PettingZoo (parallel and AEC) and, as the view of one side, with
Gymnasium. `import tab_marl` registers them; `gymnasium.make("tab_marl:tab_marl/Ego-v0")` does so by itself.

{_table(("environment", "what it is", "Gymnasium ids"), rows)}

Beside these, [batched worlds](batched.md) play hundreds of arenas at once for training. [Train on it](training.md) shows
every library at work, [Pictures](rendering.md) how episodes are drawn and filmed, and [Speed](speed.md) what was measured.

Every page of an environment is written from the code by `scripts/environment_pages.py`, and a test fails when one differs.
"""


def pages() -> dict[str, str]:
    """File name -> text of every page that is written from the code."""
    return {"index.md": index()} | {f"{e.name}.md": page(e) for e in ENVIRONMENTS}


if __name__ == "__main__":
    OUT.mkdir(parents=True, exist_ok=True)
    for name, text in pages().items():
        (OUT / name).write_text(text)
        print(OUT / name)
