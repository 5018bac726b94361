"""What runs on a cluster's node: a player of jobs that says first which code it is, and gets policies as bytes."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from tab_marl.evaluation.engines.interface import Play, Result
from tab_marl.evaluation.units import Job

Parcel = dict[str, dict[str, bytes]]
"""Adversary as a job names it -> file name -> content."""


def pack(adversaries: Sequence[str]) -> Parcel:
    """The files of every policy outside the package, which jobs name by its folder. Raises OSError."""
    return {
        name: {path.name: path.read_bytes() for path in sorted(Path(name).iterdir()) if path.is_file()}
        for name in adversaries
        if os.sep in name
    }


class Unpacked:
    """A parcel's policies as folders of this machine, until `clean`."""

    def __init__(self, parcel: Mapping[str, Mapping[str, bytes]]) -> None:
        self._places: dict[str, str] = {}
        self._folder = tempfile.TemporaryDirectory(prefix="tab-marl-policies-") if parcel else None
        for number, (name, files) in enumerate(parcel.items()):
            assert self._folder is not None
            # The folder keeps its name, which the row of a broken episode shows.
            target = Path(self._folder.name) / str(number) / Path(name).name
            target.mkdir(parents=True)
            for file, content in files.items():
                (target / Path(file).name).write_bytes(content)
            self._places[name] = str(target)

    def localised(self, job: Job) -> Job:
        """The job with the policies where they are on this machine."""
        return replace(job, adversaries=tuple(self._places.get(name, name) for name in job.adversaries))

    def clean(self) -> None:
        """Take the files away."""
        if self._folder is not None:
            self._folder.cleanup()


class Player:
    """One process on a node; made an actor by `cluster`."""

    def __init__(self, parcel: Parcel) -> None:
        self._policies = Unpacked(parcel)

    def identity(self) -> dict[str, str]:
        """`provenance.identity` of the code that this node has."""
        from tab_marl.evaluation.provenance import identity
        from tab_marl.evaluation.settings import code_fingerprint

        return identity(code_fingerprint())

    def play(self, play: Play, job: Job) -> list[Result]:
        """The results of a job."""
        return play(self._policies.localised(job))

    def clean(self) -> None:
        """Before the end."""
        self._policies.clean()
