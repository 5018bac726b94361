"""Tag for pomdp-py (h2r/pomdp-py, Cython), twice: as that package ships it, and rewritten to be as quick there as can be.

Rewritten: every state, observation and action exists once, a step is look-ups in the tables that our own Tag uses, and the rollout
draws an action from a tuple. Used by ``benchmarks/tag.py``. Both run on past terminal states, as pomdp-py's search does.
"""

from __future__ import annotations

import random
from typing import Any

import pomdp_py
from pomdp_py.problems.tag.domain.state import TagState
from pomdp_py.problems.tag.example_worlds import world0
from pomdp_py.problems.tag.models.components.grid_map import GridMap
from pomdp_py.problems.tag.models.components.motion_policy import TagTargetMotionPolicy
from pomdp_py.problems.tag.models.observation_model import TagObservationModel
from pomdp_py.problems.tag.models.policy_model import TagPolicyModel
from pomdp_py.problems.tag.models.reward_model import TagRewardModel
from pomdp_py.problems.tag.models.transition_model import TagTransitionModel

from tab_marl.planning.textbook import SEES_TARGET, TAG, TagBelief, tag_data
from tab_marl.planning.textbook.tag import PLACES

_DATA = tag_data()
_ROBOT = _DATA.robot_moves.reshape(29, 5).tolist()
_TARGET = _DATA.target_moves.reshape(29, 29, 5).tolist()


class _State(pomdp_py.State):
    def __init__(self, robot: int, target: int, found: bool) -> None:
        self.robot, self.target, self.found = robot, target, found
        self.key = (robot * 29 + target) * 2 + found

    def __hash__(self) -> int:
        return self.key

    def __eq__(self, other: object) -> bool:
        return self is other


class _Numbered(pomdp_py.Action):
    def __init__(self, number: int) -> None:
        self.number = number

    def __hash__(self) -> int:
        return self.number

    def __eq__(self, other: object) -> bool:
        return self is other


class _Seen(pomdp_py.Observation):
    def __init__(self, number: int) -> None:
        self.number = number

    def __hash__(self) -> int:
        return self.number

    def __eq__(self, other: object) -> bool:
        return self is other


_STATES = [[_State(r, t, False) for t in range(29)] for r in range(29)]
_FOUND = _State(0, 0, True)
_ACTIONS = tuple(_Numbered(a) for a in range(5))
_SEEN = [_Seen(o) for o in range(30)]


class _Transition(pomdp_py.TransitionModel):
    calls = 0

    def sample(self, state: _State, action: _Numbered) -> _State:
        self.calls += 1
        robot, target = state.robot, state.target
        if state.found or (action.number == TAG and robot == target):
            return _FOUND
        return _STATES[_ROBOT[robot][action.number]][_TARGET[robot][target][int(random.random() * 5)]]


class _Observation(pomdp_py.ObservationModel):
    def sample(self, next_state: _State, action: _Numbered) -> _Seen:
        return _SEEN[SEES_TARGET if next_state.robot == next_state.target else next_state.robot]


class _Reward(pomdp_py.RewardModel):
    def sample(self, state: _State, action: _Numbered, next_state: _State) -> float:
        if state.found:
            return 0.0
        if action.number == TAG:
            return 10.0 if next_state.found else -10.0
        return -1.0


class _Uniform(pomdp_py.RolloutPolicy):
    def rollout(self, state: _State, history: Any = None) -> _Numbered:
        return _ACTIONS[int(random.random() * 5)]

    def sample(self, state: _State) -> _Numbered:
        return self.rollout(state)

    def get_all_actions(self, state: Any = None, history: Any = None) -> tuple[_Numbered, ...]:
        return _ACTIONS


class Peer:
    """pomdp-py's POUCT on Tag, from a particle belief."""

    def __init__(self, simulations: int, exploration: float, discount: float, max_depth: int, seed: int) -> None:
        random.seed(seed)
        self.policy, self.transition = _Uniform(), _Transition()
        self.planner_of = lambda: pomdp_py.POUCT(
            max_depth=max_depth,
            planning_time=-1.0,
            num_sims=simulations,
            discount_factor=discount,
            exploration_const=exploration,
            rollout_policy=self.policy,
        )

    def plan(self, belief: TagBelief, rng: Any) -> int:
        """Plans once and returns the action; ``transition.calls`` counts the steps."""
        states = [_STATES[int(r)][int(t)] for r, t in belief.sample(1000, rng)]
        agent = pomdp_py.Agent(pomdp_py.Particles(states), self.policy, self.transition, _Observation(), _Reward())
        return int(self.planner_of().plan(agent).number)


class _MendedPolicy(TagPolicyModel):
    """As shipped, but ``random.sample`` takes no sets since Python 3.11."""

    def rollout(self, state: Any, history: Any = None) -> Any:
        return random.choice(tuple(self.get_all_actions(state=state, history=history)))


class _MendedTarget(TagTargetMotionPolicy):
    """The same for the target's moves; its rules are untouched."""

    def random(self, robot_position: Any, target_position: Any, motions: Any, mpe: bool = False) -> Any:
        if not mpe and random.uniform(0, 1) <= self._pr_stay:
            return target_position
        candidates = tuple(self._compute_candidate_actions(robot_position, target_position, motions))
        if not candidates:
            return target_position
        return TagTransitionModel.if_move_by(self._grid_map, target_position, random.choice(candidates))


class _CountedTransition(TagTransitionModel):
    calls = 0

    def sample(self, state: Any, action: Any, argmax: bool = False) -> Any:
        self.calls += 1
        return super().sample(state, action, argmax)


class ShippedPeer:
    """pomdp-py's POUCT on the Tag that pomdp-py ships (``pomdp_py.problems.tag``), in its own classes."""

    def __init__(self, simulations: int, exploration: float, discount: float, max_depth: int, seed: int) -> None:
        random.seed(seed)
        self.grid = GridMap.from_str(world0[0])
        self.policy = _MendedPolicy(grid_map=self.grid)
        self.transition = _CountedTransition(self.grid, _MendedTarget(self.grid, 0.2))
        self.planner_of = lambda: pomdp_py.POUCT(
            max_depth=max_depth,
            planning_time=-1.0,
            num_sims=simulations,
            discount_factor=discount,
            exploration_const=exploration,
            rollout_policy=self.policy,
        )

    def plan(self, belief: TagBelief, rng: Any) -> str:
        """Plans once and returns the action; ``transition.calls`` counts the steps."""
        # our rows count from below, theirs from above
        places = [(x, 4 - y) for x, y in PLACES]
        states = [TagState(places[int(r)], places[int(t)], False) for r, t in belief.sample(1000, rng)]
        agent = pomdp_py.Agent(
            pomdp_py.Particles(states), self.policy, self.transition, TagObservationModel(), TagRewardModel()
        )
        return str(self.planner_of().plan(agent))
