"""The pictures of one environment: render modes, the window, and what is laid over the map. Pygame loads when one is drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tab_marl.envs.episode import Episode
from tab_marl.envs.heat import HeatSource, heat_source
from tab_marl.envs.mission_scene import mission_scene
from tab_marl.envs.team_episode import TeamEpisode
from tab_marl.mission import to_english
from tab_marl.mission.tasks import Task
from tab_marl.world.scenario import Scenario

if TYPE_CHECKING:
    from tab_marl.envs.live_view import LiveView

RENDER_MODES = ("human", "rgb_array")
FRAMES_PER_SECOND = 10


class Pictures:
    """Draws episodes of an environment. A copy has no window and nothing laid over the map."""

    def __init__(self, title: str, render_mode: str | None, show_lidar: bool) -> None:
        """Raises ValueError for a render mode that does not exist."""
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ValueError(f"render_mode is {render_mode!r}, must be None or one of {list(RENDER_MODES)}")
        self.mode = render_mode
        self._title, self._show_lidar = title, show_lidar
        self._view: LiveView | None = None
        self._task: Task | None = None
        self._heat: HeatSource | None = None
        self._heat_label = "belief"

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_view": None, "_heat": None}

    def start(self, task: Task) -> None:
        """A new episode begins."""
        self._task = task
        if self._view is not None:
            self._start_view(self._view, task)

    def set_field(self, field: Any, scenario: Scenario, label: str) -> None:
        """See `InterceptEnv.set_field`."""
        self._heat = heat_source(field, scenario)
        self._heat_label = label

    def draw(self, episode: Episode | TeamEpisode, over: bool) -> NDArray[np.uint8] | None:
        """The picture ``[height, width, 3]`` in mode "rgb_array"; None in mode "human", which shows it in a window."""
        if self.mode is None or self._task is None:
            raise RuntimeError(f"render() needs a render_mode: make the environment with one of {list(RENDER_MODES)}")
        if self._view is None:
            from tab_marl.envs.live_view import LiveView  # loads pygame

            self._view = LiveView(self._title, self._show_lidar)
            self._start_view(self._view, self._task)
        heat = None if self._heat is None else self._heat()
        if isinstance(episode, TeamEpisode):
            frame = self._view.team_frame(episode, heat, self._heat_label, over)
        else:
            frame = self._view.frame(episode, heat, self._heat_label, over)
        if self.mode == "rgb_array":
            return self._view.array(frame)
        self._view.show(frame, FRAMES_PER_SECOND)
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._view is not None:
            self._view.close()
            self._view = None

    @staticmethod
    def _start_view(view: LiveView, task: Task) -> None:
        view.start(task.scenario, mission_scene(task.mission, task.scenario, to_english(task.mission, task.scenario)))
