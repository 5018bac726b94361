# mypy: ignore-errors
"""The pursuit as a generative model for POMCP: actions are itineraries of the ego, states an adversary path and a pose.

Arrays and scalars only; nothing here validates or raises. `data` is the tuple `decide.PursuitData`. A state is
``[path number, tick, x, y, theta, track]``: track a >= 0 says that the pose is the one at this tick of itinerary a driven
from the root, which is looked up instead of driven again (`tracks`); -1 that it is any other.

What a sighting tells is estimated from the sampled paths themselves: those that are near the seen point at that tick
are what the adversary may be doing, and each route is judged by how many of them it reaches ahead of time (`prospects`).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tab_marl.planning.pursuit.interception_kernels import meeting_fraction
from tab_marl.planning.pursuit.motion_kernels import drive
from tab_marl.world.kernels import unicycle_step

UNSEEN = 0
ENDED = -1
OFF_TRACK = -1.0
ALIKE_ENOUGH = 100
"""Paths that look alike are asked up to so many."""
TURN_TICKS = 2.0
"""Allowed for turning when a route's arrival is estimated."""


@njit(cache=True)
def sight_code(x, y, cameras, square_metres):
    """UNSEEN, or a number > 0 for the square of the map in which some camera sees the point."""
    for i in range(cameras.shape[0]):
        if math.hypot(x - cameras[i, 0], y - cameras[i, 1]) <= cameras[i, 2]:
            return 1 + int(y / square_metres) * 4096 + int(x / square_metres)
    return UNSEEN


@njit(cache=True)
def last_tick(completed, ticks):
    """The tick at which a path's scenario ends, and whether by completing its mission."""
    ends = 0 <= completed <= ticks
    return (completed if ends else ticks), ends


@njit(cache=True)
def drive_tick(x, y, theta, route, geometry, robot):
    """One tick along a route: (x, y, theta, mean of v^2 + w^2, whether it stands still)."""
    nearest, cell_metres, centres, aims, goals, waypoints = geometry
    max_speed, max_turn_rate, seconds, steps = robot
    if route == waypoints.shape[0]:
        return x, y, theta, 0.0, True
    spent, still = 0.0, False
    for _ in range(int(steps)):
        v, w = drive(
            nearest, cell_metres, centres, aims[route], goals[route], waypoints[route, 0], waypoints[route, 1],
            x, y, theta, max_speed, max_turn_rate, seconds,
        )  # fmt: skip
        still = v == 0.0 and w == 0.0
        if still:
            break
        x, y, theta = unicycle_step(x, y, theta, v, w, seconds)
        spent += (v * v + w * w) / steps
    return x, y, theta, spent, still


@njit(cache=True)
def route_at(action, tick, itineraries):
    """The route that an itinerary takes in the tick that begins at `tick`."""
    first, switch, second = itineraries
    return first[action] if tick < switch[action] else second[action]


@njit(cache=True)
def tracks(x, y, theta, itineraries, geometry, robot, found):
    """Fill `found` ``[m, T + 1, 5]``: x, y, theta, effort so far, and 1 from the tick on at which it stands for good."""
    for a in range(found.shape[0]):
        px, py, heading, total, arrived = x, y, theta, 0.0, False
        found[a, 0, 0], found[a, 0, 1], found[a, 0, 2], found[a, 0, 3], found[a, 0, 4] = px, py, heading, 0.0, 0.0
        for t in range(found.shape[1] - 1):
            if not arrived:
                route = route_at(a, t, itineraries)
                px, py, heading, spent, still = drive_tick(px, py, heading, route, geometry, robot)
                total += spent
                arrived = still and t >= itineraries[1][a]
            found[a, t + 1, 0], found[a, t + 1, 1], found[a, t + 1, 2] = px, py, heading
            found[a, t + 1, 3], found[a, t + 1, 4] = total, 1.0 if arrived else 0.0


@njit(cache=True)
def move_on(x, y, theta, t, action, on_track, data):
    """`drive_tick` along an itinerary, looked up where the pose is on its track; the last says that it stands for good."""
    if on_track:
        driven = data[11]
        return (
            driven[action, t + 1, 0], driven[action, t + 1, 1], driven[action, t + 1, 2],
            driven[action, t + 1, 3] - driven[action, t, 3], driven[action, t + 1, 4] > 0.0,
        )  # fmt: skip
    itineraries = data[6]
    to_x, to_y, to_theta, spent, still = drive_tick(x, y, theta, route_at(action, t, itineraries), data[3], data[4])
    return to_x, to_y, to_theta, spent, still and t >= itineraries[1][action]


@njit(cache=True)
def pursue(state, action, ticks, data):
    """Follow an itinerary for so many ticks, or until cameras begin or cease to see the adversary; moves `state` in place.

    Returns (observation, reward, whether the scenario ended).
    """
    paths, completed, cameras, prices, search = data[0], data[1], data[2], data[5], data[9]
    met, per_tick, per_effort, mission_completed = prices
    radius, square = search[0], search[1]
    k, t = int(state[0]), int(state[1])
    x, y, theta = state[2], state[3], state[4]
    on_track = t == 0 or state[5] == action
    last, ends = last_tick(completed[k], paths.shape[1] - 1)
    visible = sight_code(paths[k, t, 0], paths[k, t, 1], cameras, square) != UNSEEN
    reward, seen, over = 0.0, UNSEEN, t >= last
    for _ in range(ticks):
        if over:
            break
        to_x, to_y, theta, spent, _still = move_on(x, y, theta, t, action, on_track, data)
        s = meeting_fraction(
            x - paths[k, t, 0], y - paths[k, t, 1], to_x - paths[k, t + 1, 0], to_y - paths[k, t + 1, 1], radius
        )
        if s >= 0.0:
            return ENDED, reward + met + s * (per_tick + per_effort * spent), True
        x, y, t = to_x, to_y, t + 1
        reward += per_tick + per_effort * spent
        over = t >= last
        seen = sight_code(paths[k, t, 0], paths[k, t, 1], cameras, square)
        if (seen != UNSEEN) != visible:
            break
    state[1], state[2], state[3], state[4] = t, x, y, theta
    state[5] = action if on_track else OFF_TRACK
    if over:
        return ENDED, reward + (mission_completed if ends else 0.0), True
    return seen, reward, False


@njit(cache=True)
def wait_for(state, action, data):
    """The return of following an itinerary to its end and waiting there, from a state on."""
    paths, completed, prices, search = data[0], data[1], data[5], data[9]
    met, per_tick, per_effort, mission_completed = prices
    radius, closing = search[0], search[2]
    k, t = int(state[0]), int(state[1])
    x, y, theta = state[2], state[3], state[4]
    on_track = t == 0 or state[5] == action
    last, ends = last_tick(completed[k], paths.shape[1] - 1)
    reward = 0.0
    while t < last:
        to_x, to_y, theta, spent, still = move_on(x, y, theta, t, action, on_track, data)
        s = meeting_fraction(
            x - paths[k, t, 0], y - paths[k, t, 1], to_x - paths[k, t + 1, 0], to_y - paths[k, t + 1, 1], radius
        )
        if s >= 0.0:
            return reward + met + s * (per_tick + per_effort * spent)
        x, y, t = to_x, to_y, t + 1
        reward += per_tick + per_effort * spent
        if still:
            break
    while t < last:
        ax, ay = x - paths[k, t, 0], y - paths[k, t, 1]
        gap = math.hypot(ax, ay) - radius
        if gap > closing:
            skip = min(int(gap / closing), last - t)
            reward += skip * per_tick
            t += skip
            continue
        s = meeting_fraction(ax, ay, x - paths[k, t + 1, 0], y - paths[k, t + 1, 1], radius)
        if s >= 0.0:
            return reward + met + s * per_tick
        reward += per_tick
        t += 1
    return reward + (mission_completed if ends else 0.0)


@njit(cache=True)
def prospects(state, kept, alike_metres, leave_out, data, values):
    """Fill `values` ``[m]``: what each itinerary is worth from here against the paths that look alike now.

    A path looks alike if it is within `alike_metres` of the state's path at this tick. Meetings count at the waypoint of
    the leg in force only (the ego arrives by the geodesic distance and a turn, and the path must still come by), except for
    the itinerary `kept` so far, whose return is known. So a change must beat what is certain by what is guaranteed.
    `leave_out` leaves the state's own path out, so that a choice made by these values is blind to it. Paths are asked in
    turn from the state's own on, until `ALIKE_ENOUGH` were alike (they are in no order).
    Returns how many paths were alike; `values` is untouched if none was.
    """
    paths, completed, _cameras, geometry, robot, prices, itineraries, open_loop, _baseline, _search, ways, _driven = (
        data
    )
    met, per_tick, _per_effort, mission_completed = prices
    distances, first_contact, last_contact = ways
    nearest, cell_metres = geometry[0], geometry[1]
    reach = robot[0] * robot[2] * robot[3]
    k, t = int(state[0]), int(state[1])
    actions = values.shape[0]
    r = min(max(int(state[3] / cell_metres), 0), nearest.shape[0] - 1)
    c = min(max(int(state[2] / cell_metres), 0), nearest.shape[1] - 1)
    cell = nearest[r, c]
    # Which leg is in force, and when its waypoint is reached, is the same for all paths.
    rows, arrivals = np.empty(actions, dtype=np.int64), np.empty(actions)
    for a in range(actions):
        route = route_at(a, t, itineraries)
        rows[a] = a if t < itineraries[1][a] else actions + a
        arrivals[a] = t + (0.0 if route == distances.shape[0] else distances[route, cell] / reach + TURN_TICKS)
    alike = 0
    for i in range(paths.shape[0]):
        if alike == ALIKE_ENOUGH:
            break
        j = k + i if k + i < paths.shape[0] else k + i - paths.shape[0]
        last, ends = last_tick(completed[j], paths.shape[1] - 1)
        dx, dy = paths[j, t, 0] - paths[k, t, 0], paths[j, t, 1] - paths[k, t, 1]
        if (leave_out and j == k) or last <= t or dx * dx + dy * dy > alike_metres * alike_metres:
            continue
        if alike == 0:
            values[:] = 0.0
        alike += 1
        missed = per_tick * (last - t) + (mission_completed if ends else 0.0)
        for a in range(actions):
            if a == kept:
                values[a] += open_loop[a, j] - per_tick * t
                continue
            arrival = max(arrivals[a], first_contact[j, rows[a]])
            values[a] += met + per_tick * (arrival - t) if last_contact[j, rows[a]] >= arrival else missed
    if alike > 0:
        values /= alike
    return alike


@njit(cache=True)
def contacts(paths, completed, points, radius, first, last):
    """Fill ``[K, m]``: the first and last tick at which each path is within `radius` of each point, before it ends; inf
    and -1 if never.
    """
    for k in range(paths.shape[0]):
        end, _ends = last_tick(completed[k], paths.shape[1] - 1)
        for a in range(points.shape[0]):
            first[k, a], last[k, a] = np.inf, -1.0
            for t in range(end + 1):
                dx, dy = paths[k, t, 0] - points[a, 0], paths[k, t, 1] - points[a, 1]
                if dx * dx + dy * dy <= radius * radius:
                    if last[k, a] < 0.0:
                        first[k, a] = t
                    last[k, a] = t


@njit(cache=True)
def answer(state, action, observation, data):
    """The return of going on along an itinerary, and of taking the best-looking one whenever a camera sees the adversary.

    The choice is made by the other paths that look alike, so it knows no more than the ego will.
    """
    search = data[9]
    values = np.empty(data[8].shape[0])
    chosen, total = action, 0.0
    for _ in range(int(search[7])):
        if observation != UNSEEN and prospects(state, chosen, search[6], True, data, values) > 0:
            best = int(np.argmax(values))
            if values[best] > values[chosen] + search[8]:
                chosen = best
        observation, reward, over = pursue(state, chosen, data[0].shape[1], data)
        total += reward
        if over:
            return total
    return total + wait_for(state, chosen, data)


def step(state, action, data, _rng):
    """POMCP's generative step: one macro-action.

    The first one of a simulation is paid ``baseline[a] - open_loop[a, path]`` on top: a control variate, by which a
    simulation that never changes its itinerary returns exactly the itinerary's mean over all paths, and the search only
    measures what changing later is worth.

    Unless the search is to branch on sightings, one ends the simulation, paid by `answer`: so few sampled paths agree on a
    sighting that a branch below it would learn their futures by heart.
    """
    open_loop, baseline, search = data[7], data[8], data[9]
    extra = 0.0
    if state[1] == 0.0:
        extra = baseline[action] - open_loop[action, int(state[0])]
    observation, reward, over = pursue(state, action, int(search[3]), data)
    if not over and observation != UNSEEN and search[9] == 0.0:
        reward += answer(state, action, observation, data)
        over = True
    return observation, reward + extra, over


def rollout(state, action, observation, _depth, _max_depth, _discount, data, _rng):
    """The leaf: `answer`."""
    return answer(state, action, observation, data)


def prior(state, action, observation, _depth, data, values, counts):
    """At a node below the root: what the itineraries are worth against the paths that look alike (if any was seen)."""
    baseline, search, per_tick = data[8], data[9], data[5][1]
    alike = 0
    if observation != UNSEEN:
        alike = prospects(state, action, search[6], True, data, values)
    if alike == 0:
        for a in range(values.shape[0]):
            values[a] = baseline[a] - per_tick * state[1]
    for a in range(values.shape[0]):
        counts[a] = int(search[4])
    counts[action] = int(search[5])
