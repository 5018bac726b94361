"""From a running episode to pictures: keeps the trails and the last sighting, draws on demand."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tab_marl.envs.episode import Episode
from tab_marl.envs.mission_scene import MissionScene
from tab_marl.envs.physics import ADVERSARY, EGO
from tab_marl.envs.rendering import Frame, Other, Renderer, Window, lidar_ranges
from tab_marl.envs.team_episode import TeamEpisode
from tab_marl.mission import Mission, to_english
from tab_marl.world.scenario import Scenario


class LiveView:
    """Pictures of one environment's episodes. Pygame is loaded with this module, not before."""

    def __init__(self, title: str, show_lidar: bool = False) -> None:
        self._title = title
        self._show_lidar = show_lidar
        self._window: Window | None = None
        self._renderer: Renderer | None = None
        self._english: dict[Mission, str] = {}

    def start(self, scenario: Scenario, scene: MissionScene | None) -> None:
        """A new episode begins."""
        if self._renderer is None or self._renderer.scenario != scenario or self._renderer.scene != scene:
            self._renderer = Renderer(scenario, scene)

    def frame(self, episode: Episode, heat: NDArray[np.float64] | None, heat_label: str, over: bool) -> Frame:
        """The episode's present moment."""
        ego, adversary = episode.motion
        monitor = episode.monitor
        stage, visits = episode.mission_progress()
        return Frame(
            ego=ego,
            adversary=adversary,
            seconds=episode.physics_steps / episode.scenario.physics_hertz,
            ego_trail=np.array(episode.trails[EGO]),
            adversary_trail=np.array(episode.trails[ADVERSARY]),
            seen_by=episode.seen_by,
            last_seen=episode.last_seen,
            status=monitor.status,
            why_failed=monitor.why_failed,
            stage=stage,
            visits=visits,
            mission_seconds_left=monitor.seconds_left,
            intercepted=episode.intercepted,
            completed_seconds=episode.completed_seconds,
            over=over,
            ranges=lidar_ranges(episode.scenario, ego) if self._show_lidar else None,
            heat=heat,
            heat_label=heat_label,
            watched=episode.watched,
            ego_ending="Goal reached" if episode.arrived else "Encounter" if episode.encountered else "",
        )

    def team_frame(self, episode: TeamEpisode, heat: NDArray[np.float64] | None, heat_label: str, over: bool) -> Frame:
        """The present moment of a team's episode: the panel follows the first ego and the first adversary."""
        n = episode.egos
        monitor = episode.monitors[0]
        done, visits = monitor.progress[0], 0
        if monitor.location >= 0:
            visits = int(monitor.automaton.visits[monitor.location])
        others = [
            Other(motion, np.array(trail), i < n, i < n or bool(episode.seen[i - n]))
            for i, (motion, trail) in enumerate(zip(episode.motions, episode.paths, strict=True))
            if i not in (0, n) and (i < n or episode.in_play[i - n])
        ]
        return Frame(
            ego=episode.motions[0],
            adversary=episode.motions[n],
            seconds=episode.seconds,
            ego_trail=np.array(episode.paths[0]),
            adversary_trail=np.array(episode.paths[n]),
            seen_by=episode.seen[0],
            also_lit=tuple(c for j, seen in enumerate(episode.seen) if j and episode.in_play[j] for c in seen),
            also=tuple(self._line(episode, j) for j in range(1, len(episode.monitors))),
            last_seen=episode.sighted[0],
            status=monitor.status,
            why_failed=monitor.why_failed,
            stage=done,
            visits=visits,
            mission_seconds_left=monitor.seconds_left,
            intercepted=all(captor is not None for captor in episode.captor),
            completed_seconds=episode.completed_at[0],
            over=over,
            ranges=lidar_ranges(episode.scenario, episode.motions[0]) if self._show_lidar else None,
            heat=heat,
            heat_label=heat_label,
            others=tuple(others),
            adversary_in_play=episode.in_play[0],
        )

    def _line(self, episode: TeamEpisode, adversary: int) -> str:
        """What an adversary beside the first one is about, and how far it is."""
        task = episode.team.tasks[adversary]
        text = self._english.setdefault(task.mission, to_english(task.mission, task.scenario))
        state = "intercepted" if episode.captor[adversary] is not None else episode.monitors[adversary].status
        return f"{text}: {'under way' if state == 'active' else state}"

    def array(self, frame: Frame) -> NDArray[np.uint8]:
        """The picture ``[height, width, 3]``."""
        return self._drawn().array(frame)

    def show(self, frame: Frame, frames_per_second: float) -> None:
        """Show the picture in a window, which opens at the first call."""
        renderer = self._drawn()
        if self._window is None:
            self._window = Window(renderer.size, self._title)
        self._window.show(renderer.draw(frame), frames_per_second)

    def close(self) -> None:
        """Close the window, if one is open."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def _drawn(self) -> Renderer:
        if self._renderer is None:
            raise RuntimeError("nothing to draw yet: call reset first")
        return self._renderer
