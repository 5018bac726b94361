"""Textbook POMDPs with published values, to hold the planner against."""

from __future__ import annotations

from tab_marl.planning.textbook.chase_maps import EAST, NORTH, SOUTH, TAG, WEST
from tab_marl.planning.textbook.laser_tag import LaserTagBelief, laser_tag
from tab_marl.planning.textbook.light_dark import light_dark, light_dark_binned, light_dark_start
from tab_marl.planning.textbook.rock_sample import RockBelief, rock_sample
from tab_marl.planning.textbook.tag import SEES_TARGET, TagBelief, TagData, play_tag, tag, tag_data
from tab_marl.planning.textbook.tiger import HEAR_LEFT, HEAR_RIGHT, LISTEN, OPEN_LEFT, OPEN_RIGHT, tiger

__all__ = [
    "EAST",
    "HEAR_LEFT",
    "HEAR_RIGHT",
    "LISTEN",
    "NORTH",
    "OPEN_LEFT",
    "OPEN_RIGHT",
    "SEES_TARGET",
    "SOUTH",
    "TAG",
    "WEST",
    "LaserTagBelief",
    "RockBelief",
    "TagBelief",
    "TagData",
    "laser_tag",
    "light_dark",
    "light_dark_binned",
    "light_dark_start",
    "play_tag",
    "rock_sample",
    "tag",
    "tag_data",
    "tiger",
]
