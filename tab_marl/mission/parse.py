"""From English to constraint tuples, by the grammar in ``grammar.lark``."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import lru_cache
from importlib import resources
from typing import Any

from lark import Lark, Token, Tree, UnexpectedInput
from lark.lexer import PatternRE, TerminalDef

from tab_marl.mission.model import Constraint, ConstraintType, Mission, Place
from tab_marl.mission.places import MissionWorld
from tab_marl.mission.propositions import region_of
from tab_marl.mission.syntax_errors import MissionSyntaxError, explain

COUNTS = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")
DEFAULT_RECURRENCES = 3
"""A recurring goal that does not say how often counts as completed after so many visits."""


def parse_mission(
    text: str, scenario: MissionWorld, *, target: tuple[float, float] | None = None, name: str = ""
) -> Mission:
    """Read a mission such as "Reach Checkpoint A within 5s", "Visit any three different checkpoints every 10s".

    `target` replaces the placeholder of "target [x, y]". Places take any spelling the scenario knows. Goals come first
    in the result, then what runs beside them; `to_english` prints it back. Raises MissionSyntaxError.
    """
    if not text.strip():
        raise MissionSyntaxError("the mission's text is empty: write e.g. 'Reach Checkpoint A within 5s'", text)
    try:
        tree = _parser(tuple(sorted(scenario.spellings()))).parse(text)
    except UnexpectedInput as error:
        raise explain(error, text, scenario) from None
    try:
        return _Reader(scenario, target, text).mission(tree, name)
    except MissionSyntaxError:
        raise
    except ValueError as error:
        raise MissionSyntaxError(f"cannot make a mission of {text!r}: {error}", text) from error


class _KeepUnknownWords:
    """Makes the lexer keep terminals that no rule uses, so that unknown words reach the parser."""

    always_accept = ("WORD", "OTHER")

    def process(self, stream: Iterator[Token]) -> Iterator[Token]:
        return stream


@lru_cache(maxsize=32)
def _parser(spellings: tuple[str, ...], ambiguity: str = "resolve") -> Any:
    """The parser for a scenario's place names; cached, for building one takes some 50 ms."""
    longest_first = sorted(spellings, key=len, reverse=True)
    words = [r"\s+".join(re.escape(word) for word in spelling.split()) for spelling in longest_first]
    pattern = PatternRE(rf"(?:{'|'.join(words)})(?!\w)", ("i",))

    def put_places(terminal: TerminalDef) -> None:
        if terminal.name == "PLACE":
            terminal.pattern = pattern

    grammar = resources.files("tab_marl.mission").joinpath("grammar.lark").read_text(encoding="utf-8")
    return Lark(
        grammar, parser="earley", lexer="basic", ambiguity=ambiguity, edit_terminals=put_places,
        postlex=_KeepUnknownWords(), propagate_positions=True,
    )  # fmt: skip


Draft = dict[str, Any]
"""Fields of a goal constraint in the making; "column" says where it was read."""


class _Reader:
    """Turns a parse tree into constraints."""

    def __init__(self, scenario: MissionWorld, target: tuple[float, float] | None, text: str) -> None:
        self.scenario, self.target, self.text = scenario, target, text
        self.spellings = scenario.spellings()
        self.checkpoints: tuple[Place, ...] = tuple(c.name for c in scenario.checkpoints)

    def mission(self, tree: Tree[Token], name: str) -> Mission:
        drafts: list[Draft] = []
        beside: list[Constraint] = []
        for child in _trees(tree):
            if child.data == "beside_list":
                beside = [self._beside(b, drafts) for b in _trees(child)]
            else:
                drafts = self._plan(child)
        return Mission((*(_goal(d) for d in drafts), *beside), name)

    def _plan(self, tree: Tree[Token]) -> list[Draft]:
        drafts: list[Draft] = []
        gap = None
        for child in _trees(tree):
            if child.data == "each":
                seconds = _seconds(child)
                for draft in drafts:
                    self._set_time(draft, child, ConstraintType.DEADLINE, seconds)
                    draft["since"] = "previous"
            elif child.data == "gap":
                gap = _seconds(child)
            else:
                goal = child if child.data == "goal" else _trees(child)[0]
                drafts.append({})
                drafts[-1:] = self._goal(goal)
        if tree.data == "goal_first":
            first = len(self._goal(_trees(tree)[0]))
            drafts = drafts[first:] + drafts[:first]
        if gap is not None:
            for draft in drafts:
                if "max_gap_seconds" in draft:
                    raise self._error(tree, "a goal has its own 'at most ... apart': say the gap once")
                draft["max_gap_seconds"] = gap
        return drafts

    def _goal(self, tree: Tree[Token]) -> list[Draft]:
        target, *modifiers = _trees(tree)
        if target.data.startswith("ordered"):
            return [{"places": (place,)} for place in self._ordered(target)]
        draft: Draft = self._target(target)
        for modifier in modifiers:
            self._modify(draft, modifier)
        return [draft]

    def _ordered(self, tree: Tree[Token]) -> list[Place]:
        if tree.data == "ordered_checkpoints":
            return [self._checkpoint(label) for label in _trees(tree)]
        listing = _trees(_trees(tree)[0])
        if any(item.data == "another" for item in listing):
            raise self._error(tree, "'any checkpoint' has no place in a fixed order: use 'then any checkpoint'")
        return [self._place(_trees(item)[0]) for item in listing]

    def _checkpoint(self, label: Tree[Token]) -> Place:
        spelling = f"checkpoint {_tokens(label)[0]}".casefold()
        if spelling not in self.spellings:
            raise self._error(
                label, f"no {spelling!r} in this scenario: it has {', '.join(map(str, self.checkpoints))}"
            )
        return self.spellings[spelling]

    def _target(self, tree: Tree[Token]) -> Draft:
        kind, children = str(tree.data), _trees(tree)
        if kind in ("one_place", "any_of"):
            return {"places": tuple(self._place(c) for c in children)}
        if kind == "any_checkpoint":
            return {"places": self.checkpoints}
        if kind == "all_of":
            named = tuple(self._place(_trees(c)[0]) for c in _trees(children[0]) if c.data != "another")
            others = len(_trees(children[0])) - len(named)
            if not others:
                return {"places": named, "different": len(named)}
            places = tuple(dict.fromkeys((*named, *self.checkpoints)))
            return {"places": places, "different": len(named) + others, "including": named}
        places = self.checkpoints
        if kind == "some_of":
            items = [self._set_item(item) for item in _trees(children[1])]
            places = tuple(dict.fromkeys(place for item in items for place in item))
        draft: Draft = {"places": places, "different": _count(children[0])}
        if draft["different"] < 1:
            raise self._error(children[0], "how many places must be 1 or more")
        if children[-1].data == "including":
            draft["including"] = tuple(self._place(p) for p in _trees(children[-1]))
        return draft

    def _set_item(self, tree: Tree[Token]) -> tuple[Place, ...]:
        children = _trees(tree)
        return (self._place(children[0]),) if children else self.checkpoints

    def _set_time(self, draft: Draft, at: Tree[Token], kind: ConstraintType, seconds: float) -> None:
        if "type" in draft:
            raise self._error(at, "this goal already has a time: give each goal one")
        draft["type"], draft["seconds"] = kind, seconds

    def _modify(self, draft: Draft, tree: Tree[Token]) -> None:
        kind, children = str(tree.data), _trees(tree)
        if kind in ("within", "exactly", "present"):
            kind_of_time = ConstraintType.DEADLINE if kind == "within" else ConstraintType.EXACT
            self._set_time(draft, tree, kind_of_time, _seconds(tree))
            if kind == "present":
                draft["presence"] = True
            if children[-1].data == "since":
                draft["since"] = "previous"
        elif kind in ("every", "exactly_every"):
            kind_of_time = ConstraintType.DEADLINE if kind == "every" else ConstraintType.EXACT
            self._set_time(draft, tree, kind_of_time, _seconds(tree))
            draft["recurrences"] = self._recurrences(draft, tree)
        elif kind == "apart":
            draft["max_gap_seconds"] = _seconds(tree)
        elif kind == "slowly":
            draft["speed_limit"] = _number(tree)
        else:
            draft["restricted"] = self._places(children[0])

    def _recurrences(self, draft: Draft, tree: Tree[Token]) -> int:
        different: int = draft.get("different", 1)
        times = [child for child in _trees(tree) if child.data == "times"]
        if not times:
            return different if different > 1 else DEFAULT_RECURRENCES
        said = _count(_trees(times[0])[0]) if _trees(times[0]) else 2
        if said < 2 or (different > 1 and said != different):
            must = f"{different}, one for each different place" if different > 1 else "2 or more"
            raise self._error(times[0], f"{said} times: a recurring goal here needs {must}")
        return said

    def _beside(self, tree: Tree[Token], drafts: list[Draft]) -> Constraint:
        children = _trees(tree)
        if tree.data == "never_faster":
            return Constraint(ConstraintType.ALWAYS, speed_limit=_number(tree))
        places, avoid = self._places(children[0]), tree.data == "avoiding"
        if len(children) == 1:
            return Constraint(ConstraintType.ALWAYS, places, avoid=avoid)
        until = children[1]
        if until.data == "until_seconds":
            return Constraint(ConstraintType.UNTIL, places, _seconds(until), avoid=avoid)
        return Constraint(ConstraintType.UNTIL, places, avoid=avoid, until_goal=self._until_goal(until, drafts))

    def _until_goal(self, tree: Tree[Token], drafts: list[Draft]) -> int:
        if tree.data == "until_goal":
            number = int(_number(tree))
            if not 1 <= number <= len(drafts):
                raise self._error(tree, f"there is no goal {number}: this mission has {len(drafts)}")
            return number - 1
        place = self._place(_trees(tree)[0])
        for index, draft in enumerate(drafts):
            if draft["places"] == (place,):
                return index
        raise self._error(tree, "'until reaching' needs a place that is one of the mission's goals")

    def _places(self, tree: Tree[Token]) -> tuple[Place, ...]:
        return tuple(self._place(place) for place in _trees(tree))

    def _place(self, tree: Tree[Token]) -> Place:
        children = _trees(tree)
        if not children:
            return self.spellings[" ".join(_tokens(tree)[0].casefold().split())]
        numbers = [t for t in _tokens(children[0]) if t.type == "NUMBER"]
        if numbers:
            point = (float(numbers[0]), float(numbers[1]))
        elif self.target is not None:
            point = (float(self.target[0]), float(self.target[1]))
        else:
            raise self._error(tree, "[x, y] stands for a point: write its coordinates in metres, e.g. [1.2, 2.4]")
        try:
            region_of(point, self.scenario)
        except ValueError as error:
            raise self._error(tree, str(error)) from None
        return point

    def _error(self, at: Tree[Token], message: str) -> MissionSyntaxError:
        begin = at.meta.start_pos
        return MissionSyntaxError.at(self.text, begin, at.meta.end_pos - begin, message)


def _goal(draft: Draft) -> Constraint:
    fields: Draft = {"type": ConstraintType.EVENTUALLY} | draft
    return Constraint(**fields)


def _trees(tree: Tree[Token]) -> list[Tree[Token]]:
    return [child for child in tree.children if isinstance(child, Tree)]


def _tokens(tree: Tree[Token]) -> list[Token]:
    return [child for child in tree.children if isinstance(child, Token)]


def _number(tree: Tree[Token]) -> float:
    return float(next(token for token in _tokens(tree) if token.type == "NUMBER"))


def _seconds(tree: Tree[Token]) -> float:
    return _number(next(child for child in _trees(tree) if child.data == "duration"))


def _count(tree: Tree[Token]) -> int:
    token = _tokens(tree)[0]
    return COUNTS.index(token.casefold()) if token.type == "COUNT" else int(float(token))
