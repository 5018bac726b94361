# mypy: ignore-errors
"""Compiled loops of the batched arenas: N arenas with an ego and an adversary each, one control step at a time.

Arrays and scalars only; nothing here validates or raises. `bank` is `adversary_tables.Tables`, `duel` is
`batched_arenas.Duels`: what the ego and its task add, a row per task. What happens in a step, and in which order, is what
`episode.Episode.step` does.
"""

from __future__ import annotations

import math

from numba import njit

from tab_marl.envs.adversary_kernels import (
    DISC_AT,
    DISCS,
    EDGE_AT,
    EDGES,
    INITIAL,
    LOCATION_AT,
    MAX_SPEED,
    MAX_TURN,
    RADIUS,
    SUBSTEPS,
    TICK_SECONDS,
    gained,
    observe,
    region_distance,
    task_advance,
)
from tab_marl.envs.lidar_kernels import free_distance
from tab_marl.envs.motion_kernels import drive, push_out

COMPLETED, FAILED = -1, -2
# Ego tasks.
INTERCEPTION, AVOIDANCE, SURVEILLANCE = 0, 1, 2
# Columns of Duels.number.
EGO_TASK, LAST_STEP, FORGIVE_STEPS, CAMERAS, RAYS, HAS_GOAL = 0, 1, 2, 3, 4, 5
NUMBERS = 6
# Columns of Duels.real.
EGO_RADIUS, EGO_SPEED, EGO_TURN, MEETING, SAFE_GAP, WATCH, RAY_METRES, NOTICE = 0, 1, 2, 3, 4, 5, 6, 7
TICKS_PER_STEP = 8  # ticks of Scenario.step_seconds per control step: what is charged per time step
P_MEET, P_COLLISION, P_STEP, P_CONTROL, P_COMPLETED, P_ENCOUNTER, P_ARRIVAL, P_WATCHED = 9, 10, 11, 12, 13, 14, 15, 16
A_COMPLETED, A_FAILED, A_MET, A_COLLISION, A_STEP, A_PROGRESS, A_EXCESS = 17, 18, 19, 20, 21, 22, 23
GOAL_X, GOAL_Y = 24, 25
REALS = 26
# Columns of the events of a step, float64 0 or 1.
E_INTERCEPTED, E_COMPLETED, E_FAILED, E_EGO_COLLIDED, E_ADVERSARY_COLLIDED, E_ENCOUNTERED, E_ARRIVED, E_WATCHED = (
    0, 1, 2, 3, 4, 5, 6, 7,
)  # fmt: skip
EVENTS = 8
# Columns of the counters of an arena.
STEPS, DONE_SUBSTEPS, FORGIVEN_EGO, FORGIVEN_ADVERSARY, MISSION, VISITS = 0, 1, 2, 3, 4, 5
COUNTERS = 6
ROWS_WITHOUT_LIDAR = 15
BOUNDARY = 1e-9
SPEED_TOLERANCE = 0.02


@njit(cache=True)
def sees(bank, k, x, y, other_x, other_y):
    """Whether the straight line between two points is free of obstacles."""
    dx, dy = other_x - x, other_y - y
    far = math.hypot(dx, dy)
    if far == 0.0:
        return True
    number = bank.number[k]
    discs = bank.ray_discs[number[DISC_AT] : number[DISC_AT] + number[DISCS]]
    edges = bank.ray_edges[number[EDGE_AT] : number[EDGE_AT] + number[EDGES]]
    return free_distance(x, y, dx / far, dy / far, far, discs, edges) >= far


@njit(cache=True)
def in_camera(duel, k, x, y):
    """Whether a point lies under a camera."""
    for c in range(duel.number[k, CAMERAS]):
        if math.hypot(x - duel.camera[k, c, 0], y - duel.camera[k, c, 1]) <= duel.camera[k, c, 2] + BOUNDARY:
            return True
    return False


@njit(cache=True)
def watches(bank, duel, k, robots):
    """Surveillance: whether the ego is near the adversary with a free line of sight."""
    if duel.number[k, EGO_TASK] != SURVEILLANCE:
        return False
    x, y, ox, oy = robots[0, 0], robots[0, 1], robots[1, 0], robots[1, 1]
    return math.hypot(ox - x, oy - y) <= duel.real[k, WATCH] + BOUNDARY and sees(bank, k, x, y, ox, oy)


@njit(cache=True)
def write_ego(bank, duel, k, robots, counter, watched, full, out):
    """The ego's observation ``out[15 (+2) + rays]``; layout: `ego_observation.ego_rows`."""
    number, real = duel.number[k], duel.real[k]
    seconds = counter[DONE_SUBSTEPS] * bank.real[k, TICK_SECONDS] / bank.number[k, SUBSTEPS]
    x, y, theta = robots[0, 0], robots[0, 1], robots[0, 2]
    out[:] = 0.0
    _write_robot(robots[0], real[EGO_SPEED], out, 0)
    out[6] = seconds
    out[7] = max(0.0, number[LAST_STEP] * bank.real[k, TICK_SECONDS] - seconds)
    if full or watched or in_camera(duel, k, robots[1, 0], robots[1, 1]):
        out[8] = 1.0
        _write_robot(robots[1], bank.real[k, MAX_SPEED], out, 9)
    at = ROWS_WITHOUT_LIDAR
    if number[HAS_GOAL]:
        out[at], out[at + 1] = real[GOAL_X], real[GOAL_Y]
        at += 2
    rays = number[RAYS]
    if rays:
        first, last = bank.number[k, DISC_AT], bank.number[k, DISC_AT] + bank.number[k, DISCS]
        discs = bank.ray_discs[first:last]
        first, last = bank.number[k, EDGE_AT], bank.number[k, EDGE_AT] + bank.number[k, EDGES]
        edges = bank.ray_edges[first:last]
        for i in range(rays):
            a = theta + 2.0 * math.pi * i / rays
            out[at + i] = free_distance(x, y, math.cos(a), math.sin(a), real[RAY_METRES], discs, edges)


@njit(cache=True)
def _write_robot(robot, top_speed, out, at):
    out[at], out[at + 1] = robot[0], robot[1]
    out[at + 2], out[at + 3] = math.cos(robot[2]), math.sin(robot[2])
    out[at + 4] = min(max(robot[3], -top_speed), top_speed)
    out[at + 5] = robot[4]


@njit(cache=True)
def write_adversary(bank, duel, k, robots, location, clocks, memory, out):
    """The adversary's observation ``out[OBSERVED]``; it notices an ego in range and in sight. Returns what `observe` does."""
    reach = duel.real[k, NOTICE]
    x, y, ex, ey = robots[1, 0], robots[1, 1], robots[0, 0], robots[0, 1]
    noticed = reach > 0.0 and math.hypot(ex - x, ey - y) <= reach and sees(bank, k, x, y, ex, ey)
    return observe(
        bank, k, x, y, robots[1, 2], robots[1, 3], robots[1, 4], location, clocks, memory, noticed, ex, ey, out
    )  # fmt: skip


@njit(cache=True)
def begin_many(
    bank, duel, which, task, start, full, robots, location, clocks, memory, potential, counter, ego_out, adversary_out
):  # fmt: skip
    """Begin episodes in the arenas ``which[M]`` from poses ``start[M, 2, 3]`` of ego and adversary."""
    for j in range(which.shape[0]):
        i = which[j]
        k = task[i]
        robots[i] = 0.0
        robots[i, :, :3] = start[j]
        memory[i, :] = 0
        clocks[i, :] = -1
        counter[i, :] = 0
        counter[i, FORGIVEN_EGO] = counter[i, FORGIVEN_ADVERSARY] = -1
        x, y = robots[i, 1, 0], robots[i, 1, 1]
        location[i], _ = task_advance(bank, k, bank.number[k, INITIAL], clocks[i], x, y)
        counter[i, MISSION] = min(location[i], 0)
        watched = watches(bank, duel, k, robots[i])
        write_ego(bank, duel, k, robots[i], counter[i], watched, full, ego_out[i])
        potential[i, 0], potential[i, 1] = write_adversary(
            bank, duel, k, robots[i], location[i], clocks[i], memory[i], adversary_out[i]
        )


@njit(cache=True, nogil=True)
def step_many(
    bank, duel, task, ego_action, adversary_action, end_on_completion, full, robots, location, clocks, memory, potential,
    counter, reward, terminated, truncated, event, ego_out, adversary_out,
):  # fmt: skip
    """One control step of every arena; actions ``[N, 2]`` in [-1, 1] (clipped), reward ``[N, 2]`` of ego and adversary."""
    for i in range(task.shape[0]):
        k = task[i]
        real, number = duel.real[k], duel.number[k]
        tick = bank.real[k, TICK_SECONDS]
        ego_v = 0.5 * (min(max(ego_action[i, 0], -1.0), 1.0) + 1.0) * real[EGO_SPEED]
        ego_w = min(max(ego_action[i, 1], -1.0), 1.0) * real[EGO_TURN]
        v = 0.5 * (min(max(adversary_action[i, 0], -1.0), 1.0) + 1.0) * bank.real[k, MAX_SPEED]
        w = min(max(adversary_action[i, 1], -1.0), 1.0) * bank.real[k, MAX_TURN]
        met, ego_hit, hit, done = _move_both(bank, duel, k, robots[i], ego_v, ego_w, v, w)
        counter[i, DONE_SUBSTEPS] += done
        counter[i, STEPS] += 1
        event[i, :] = 0.0
        before, via, dropped = location[i], memory[i, 0], memory[i, 1]
        active = before >= 0
        kind = number[EGO_TASK]
        ended = False
        if kind == INTERCEPTION and met:
            event[i, E_INTERCEPTED], ended = 1.0, True
        elif kind == AVOIDANCE and met:
            event[i, E_ENCOUNTERED], ended = 1.0, True
        elif kind == AVOIDANCE and _at_goal(duel, k, robots[i, 0, 0], robots[i, 0, 1]):
            event[i, E_ARRIVED], ended = 1.0, True
        if active and not met:
            _advance_mission(bank, k, i, robots, location, clocks, counter, event)
        watched = watches(bank, duel, k, robots[i])
        event[i, E_WATCHED] = 1.0 if watched else 0.0
        event[i, E_EGO_COLLIDED] = _collided(ego_hit, counter[i], FORGIVEN_EGO, number[FORGIVE_STEPS])
        event[i, E_ADVERSARY_COLLIDED] = _collided(hit, counter[i], FORGIVEN_ADVERSARY, number[FORGIVE_STEPS])
        if end_on_completion and (event[i, E_COMPLETED] or event[i, E_FAILED]):
            ended = True
        terminated[i] = ended
        truncated[i] = not ended and counter[i, STEPS] >= number[LAST_STEP]
        reward[i, 0] = _ego_reward(real, kind, event[i], robots[i, 0], tick)
        write_ego(bank, duel, k, robots[i], counter[i], watched, full, ego_out[i])
        length, excess = write_adversary(
            bank, duel, k, robots[i], location[i], clocks[i], memory[i], adversary_out[i]
        )  # fmt: skip
        metres, waited = gained(
            before, location[i], via, dropped, memory[i], potential[i, 0], potential[i, 1], length, excess
        )  # fmt: skip
        potential[i, 0], potential[i, 1] = length, excess
        reward[i, 1] = _adversary_reward(real, event[i], active, metres, waited)


@njit(cache=True)
def _move_both(bank, duel, k, robots, ego_v, ego_w, v, w):
    """Both robots for one control step, until they meet if that ends the episode: (met, ego touched, adversary touched,
    substeps)."""
    real = duel.real[k]
    count = bank.number[k, SUBSTEPS]
    seconds = bank.real[k, TICK_SECONDS] / count
    radius, other = real[EGO_RADIUS], bank.real[k, RADIUS]
    surveillance = duel.number[k, EGO_TASK] == SURVEILLANCE
    gap = math.hypot(robots[0, 0] - robots[1, 0], robots[0, 1] - robots[1, 1])
    alone = gap > real[SAFE_GAP]
    if surveillance:
        alone = gap > radius + other + (real[EGO_SPEED] + bank.real[k, MAX_SPEED]) * seconds * count
    rounds, each = (1, count) if alone else (count, 1)
    ego_hit = hit = met = False
    done = 0
    for _ in range(rounds):
        x, y, theta, speed, touched = drive(
            bank, k, robots[0, 0], robots[0, 1], robots[0, 2], ego_v, ego_w, radius, seconds, each
        )
        robots[0, 0], robots[0, 1], robots[0, 2], robots[0, 3], robots[0, 4] = x, y, theta, speed, ego_w
        ego_hit = ego_hit or touched
        x, y, theta, speed, touched = drive(
            bank, k, robots[1, 0], robots[1, 1], robots[1, 2], v, w, other, seconds, each
        )
        robots[1, 0], robots[1, 1], robots[1, 2], robots[1, 3], robots[1, 4] = x, y, theta, speed, w
        hit = hit or touched
        done += each
        if alone:
            continue
        dx, dy = robots[1, 0] - robots[0, 0], robots[1, 1] - robots[0, 1]
        gap = math.hypot(dx, dy)
        if not surveillance and gap <= real[MEETING]:
            met = True
            break
        overlap = radius + other - gap
        if overlap > 0.0 and gap > 0.0:
            # Bodies of equal standing: each yields half.
            sx, sy = 0.5 * overlap * dx / gap, 0.5 * overlap * dy / gap
            robots[0, 0], robots[0, 1], _ = push_out(bank, k, robots[0, 0] - sx, robots[0, 1] - sy, radius)
            robots[1, 0], robots[1, 1], _ = push_out(bank, k, robots[1, 0] + sx, robots[1, 1] + sy, other)
    return met, ego_hit, hit, done


@njit(cache=True)
def _at_goal(duel, k, x, y):
    if not duel.number[k, HAS_GOAL]:
        return False
    return region_distance(duel.goal_disc, duel.goal_first, duel.goal_halfplanes, k, x, y) <= BOUNDARY


@njit(cache=True)
def _advance_mission(bank, k, i, robots, location, clocks, counter, event):
    """The adversary's mission reads where it is; driving faster than the mission allows fails it."""
    limit = bank.speed_limit[bank.number[k, LOCATION_AT] + location[i]]
    if robots[i, 1, 3] > limit * (1.0 + SPEED_TOLERANCE):
        location[i] = FAILED
    else:
        location[i], counted = task_advance(bank, k, location[i], clocks[i], robots[i, 1, 0], robots[i, 1, 1])
        counter[i, VISITS] += counted
    if location[i] < 0:
        counter[i, MISSION] = location[i]
        event[i, E_COMPLETED if location[i] == COMPLETED else E_FAILED] = 1.0


@njit(cache=True)
def _collided(touching, counter, robot, forgive):
    """1.0 if a new collision began: a touch within one tick of the last touch is still the same one."""
    if not touching:
        return 0.0
    new = counter[STEPS] > counter[robot]
    counter[robot] = counter[STEPS] + forgive
    return 1.0 if new else 0.0


@njit(cache=True)
def _ego_reward(real, kind, event, ego, seconds):
    """`reward.ego_reward`."""
    effort = ego[3] * ego[3] + ego[4] * ego[4]
    reward = (real[P_STEP] + real[P_CONTROL] * effort) * real[TICKS_PER_STEP]
    reward += real[P_MEET] * event[E_INTERCEPTED] + real[P_COLLISION] * event[E_EGO_COLLIDED]
    if kind == INTERCEPTION:
        reward += real[P_COMPLETED] * event[E_COMPLETED]
    elif kind == AVOIDANCE:
        reward += real[P_ENCOUNTER] * event[E_ENCOUNTERED] + real[P_ARRIVAL] * event[E_ARRIVED]
    else:
        reward += real[P_WATCHED] * seconds * event[E_WATCHED]
    return reward


@njit(cache=True)
def _adversary_reward(real, event, active, metres, waited):
    """`reward.adversary_reward`."""
    reward = real[A_COLLISION] * event[E_ADVERSARY_COLLIDED] + real[A_PROGRESS] * metres + real[A_EXCESS] * waited
    if active:
        reward += real[A_STEP] * real[TICKS_PER_STEP] + real[A_MET] * event[E_INTERCEPTED]
    return reward + real[A_COMPLETED] * event[E_COMPLETED] + real[A_FAILED] * event[E_FAILED]
