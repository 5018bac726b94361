"""Why a mission's text cannot be read: the place, what was expected there, and the nearest known name."""

from __future__ import annotations

import difflib
import re

from lark import UnexpectedCharacters, UnexpectedInput, UnexpectedToken

from tab_marl.mission.places import MissionWorld

PHRASES: dict[str, tuple[str, ...]] = {
    "REACH": ("Reach", "Visit", "Go to"),
    "END_AT": ("end at",),
    "THEN": ("then",),
    "ANY": ("any",),
    "CHECKPOINT": ("checkpoint",),
    "CHECKPOINTS": ("checkpoints",),
    "COUNT": ("two", "three"),
    "DIFFERENT": ("different",),
    "OF": ("of",),
    "INCLUDING": ("including",),
    "IN_ORDER": ("in order",),
    "IN_ANY_ORDER": ("in any order",),
    "WITHIN": ("within",),
    "IN_EXACTLY": ("in exactly",),
    "PRESENT": ("present at exactly",),
    "EVERY": ("every",),
    "EXACTLY_EVERY": ("exactly every",),
    "EACH_WITHIN": ("each within",),
    "AT_MOST": ("at most",),
    "APART": ("apart",),
    "NO_FASTER": ("no faster than",),
    "WITHOUT_ENTERING": ("without entering",),
    "AFTER_VISITING": ("after visiting",),
    "AFTER_PREVIOUS": ("after the previous goal",),
    "TAKING": ("taking no more than",),
    "BETWEEN": ("between checkpoints", "between visits"),
    "TIMES": ("times",),
    "TWICE": ("twice",),
    "WHILE": ("while",),
    "AVOIDING": ("avoiding", "never entering", "Avoid"),
    "STAYING_IN": ("staying in", "Stay in"),
    "NEVER_FASTER": ("never faster than",),
    "UNTIL": ("until",),
    "FOR_FIRST": ("for the first",),
    "REACHING": ("reaching",),
    "GOAL": ("goal",),
    "IS_DONE": ("is reached", "is completed"),
    "SECONDS": ("seconds", "s"),
    "METRES_PER_SECOND": ("m/s",),
    "AND": ("and",),
    "OR": ("or",),
    "TARGET": ("target",),
    "COMMA": (",",),
    "RIGHT_BRACKET": ("]",),
}
"""Terminal -> how it is written, the usual form first."""

KINDS = {
    "PLACE": "a place",
    "LEFT_BRACKET": "a point [x, y]",
    "NUMBER": "a number",
    "LETTER": "a checkpoint's letter",
    "$END": "the end",
}
"""Terminals named by what they stand for."""

GROUPS = {
    "a time such as 'within 5s'": {"WITHIN", "IN_EXACTLY", "PRESENT", "EVERY", "EXACTLY_EVERY", "EACH_WITHIN"},
    "a condition such as 'without entering ...'": {"AT_MOST", "NO_FASTER", "WITHOUT_ENTERING"},
}
"""Terminals said together when more than one of them is expected."""

UNSAID = {"PERIOD", "UNNAMED_POINT", "TARGET", "COMMA", "COUNT"}
"""Expected terminals that would only lengthen the message."""

CLOSE_ENOUGH = 0.6


class MissionSyntaxError(ValueError):
    """A mission's text that cannot be read."""

    def __init__(
        self, message: str, text: str, column: int = 1, expected: tuple[str, ...] = (), suggestion: str | None = None
    ) -> None:
        super().__init__(message)
        self.text = text
        self.column = column
        """From 1."""
        self.expected = expected
        """What could have stood there, in words."""
        self.suggestion = suggestion
        """The nearest known name or phrase, if any is near."""

    @classmethod
    def at(
        cls, text: str, begin: int, width: int, message: str, expected: tuple[str, ...] = (),
        suggestion: str | None = None,
    ) -> MissionSyntaxError:  # fmt: skip
        """Points at `width` characters from index `begin`."""
        shown = re.sub(r"\s", " ", text)
        caret = " " * begin + "^" * max(1, width)
        return cls(
            f"cannot read the mission at column {begin + 1}:\n  {shown}\n  {caret}\n{message}",
            text, begin + 1, expected, suggestion,
        )  # fmt: skip


def explain(error: UnexpectedInput, text: str, scenario: MissionWorld) -> MissionSyntaxError:
    """The parser's complaint in words."""
    terminals: set[str] = set()
    if isinstance(error, UnexpectedToken):
        terminals = set(error.accepts or error.expected)
    elif isinstance(error, UnexpectedCharacters):
        terminals = set(error.allowed or ())
    else:
        terminals = set(getattr(error, "expected", ()))
    begin = len(text.rstrip())
    token = getattr(error, "token", None)
    if token is not None and token.type != "$END" and token.start_pos is not None:
        begin = token.start_pos
    elif isinstance(error, UnexpectedCharacters) and error.pos_in_stream is not None:
        begin = error.pos_in_stream
    expected = _in_words(terminals)
    found, suggestions = _nearest(text[begin:], terminals, scenario)
    width = len(found) if found else len(_first_words(text[begin:], 1))
    message = f"expected {' or '.join([', '.join(expected[:-1]), expected[-1]] if expected[1:] else expected)}"
    if suggestions:
        message += f'; "{found}": did you mean {" or ".join(repr(s) for s in suggestions)}?'
    elif "PLACE" in terminals and begin < len(text.rstrip()):
        message += f"; known places: {', '.join(name for name, _ in scenario.named_regions())}"
    return MissionSyntaxError.at(text, begin, width, message, tuple(expected), suggestions[0] if suggestions else None)


def _in_words(terminals: set[str]) -> list[str]:
    said = [KINDS[t] for t in KINDS if t in terminals and t != "$END"]
    for name, group in GROUPS.items():
        if len(terminals & group) > 1:
            said.append(name)
            terminals = terminals - group
    form = -1 if "REACH" in terminals else 0  # "Avoid ..." begins a mission, "while avoiding ..." ends one
    said += [f"'{PHRASES[t][0 if t == 'REACH' else form]}'" for t in PHRASES if t in terminals and t not in UNSAID]
    if "$END" in terminals:
        said.append("the end")
    return said or ["something else"]


def _first_words(text: str, count: int) -> str:
    match = re.match(r"\s*[^\s,.]+" + r"\s+[^\s,.]+" * (count - 1), text)
    return match.group().strip() if match else ""


def _nearest(text: str, terminals: set[str], scenario: MissionWorld) -> tuple[str, list[str]]:
    """(the words that were probably misspelt, the equally near known spellings); ("", []) if nothing is near."""
    known: list[tuple[str, str, str, float]] = []  # spelling, how to show it, what it means, handicap
    if "PLACE" in terminals:
        shown = {name.casefold(): name for name, _ in scenario.named_regions()}
        known += [(s, shown.get(s, s), meaning, 0.0) for s, meaning in scenario.spellings().items()]
    for terminal in terminals:
        # Where a place could stand, a misspelt place is likelier than a misspelt word.
        handicap = 0.1 if "PLACE" in terminals else 0.0
        known += [(p.casefold(), p, terminal, handicap) for p in PHRASES.get(terminal, ()) if len(p) > 1]
    best, found, suggestions = CLOSE_ENOUGH, "", dict[str, str]()
    for count in range(1, 7):
        words = _first_words(text, count)
        if len(words.split()) < count:
            break
        plain = " ".join(words.casefold().split())
        for spelling, display, meaning, handicap in known:
            near = difflib.SequenceMatcher(None, plain, spelling).ratio() - handicap
            if near > best + 1e-9:
                best, found, suggestions = near, words, {meaning: display}
            elif near > best - 1e-9 and words == found:
                suggestions.setdefault(meaning, display)
    return found, list(suggestions.values())[:5]
