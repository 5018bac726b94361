"""A Ray cluster of several nodes on this machine: the same rows as without it, also when a node is killed in the middle."""

import os
from pathlib import Path

import pytest

ray = pytest.importorskip("ray")

from ray.cluster_utils import Cluster

from tab_marl.evaluation.engines.cluster import RayEngine
from tab_marl.evaluation.engines.cluster_worker import Unpacked, pack
from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.provenance import identity
from tab_marl.evaluation.runner import Watch, run
from tab_marl.evaluation.settings import EvaluationSettings, code_fingerprint
from tab_marl.evaluation.store import Store
from tab_marl.evaluation.units import Job, Unit

SETTINGS = EvaluationSettings(
    missions=("M1", "M3"), families=("point",), planners=("S-POMCP", "MLE-POMCP", "TAB-POMCP"), episodes=12, seed=7
)
SMALL = {"num_cpus": 1, "object_store_memory": 80 * 2**20, "include_dashboard": False}


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """Three nodes of a processor each."""
    here, nodes = str(Path(__file__).parent), tmp_path_factory.mktemp("nodes")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")])))
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("SYNTHETIC_NODES", str(nodes))
        made = Cluster(initialize_head=True, head_node_args={**SMALL, "include_log_monitor": False})
        (nodes / "head").write_text(made.head_node.node_id)
        for _ in range(2):
            made.add_node(wait=False, **SMALL)
        made.wait_for_nodes()
        yield made
        ray.shutdown()
        made.shutdown()


@pytest.fixture(scope="module")
def ours():
    return identity(code_fingerprint())


def test_killing_a_node_changes_no_row(cluster, ours, tmp_path, synthetic):
    expected = {row.key: (row, row.learned) for row in everything(synthetic)}
    notes, nodes_seen = [], set()

    def on_result(results):
        nodes_seen.update(timing.traceback for _, timing in results)

    with Store.create(tmp_path) as store:
        store.use("k", {}, {})
        engine = RayEngine(synthetic.play_where_a_node_dies, ours, cluster.address)
        run_id = store.begin_run("k", {})
        run(SETTINGS, ("a", "b"), store, "k", engine, run_id, Watch(on_result, on_note=notes.append))
        rows = {row.key: (row, store.learned("k", *row.key)) for row in store.rows("k")}
    assert {key: (repr(row), learned) for key, (row, learned) in rows.items()} == {
        key: (repr(_without_learned(row)), learned) for key, (row, learned) in expected.items()
    }
    assert len(rows) == 72
    assert len(nodes_seen) == 3, "every node had played"
    assert any("a worker was lost (on node" in note and "trying again" in note for note in notes)


def everything(synthetic):
    """The rows that one process plays one after the other."""
    for mission in SETTINGS.missions:
        learned = None
        for seed in range(SETTINGS.episodes):
            for planner in SETTINGS.planners:
                carried = learned if planner == "MLE-POMCP" else None
                job = Job(Unit(mission, "point", seed), (planner,), 7, None, ("a", "b"), "default", carried)
                ((row, _),) = synthetic.play(job)
                learned = row.learned or learned
                yield row


def _without_learned(row):
    import dataclasses

    return dataclasses.replace(row, learned=None)


def test_other_code_is_refused(cluster, ours, synthetic):
    notes = []
    engine = RayEngine(synthetic.play, ours | {"code": "0123"}, cluster.address, on_note=notes.append)
    with (
        pytest.raises(UserError, match=r"no node .* is refused: code \w+ instead of 0123; install the same version"),
        engine,
    ):
        for _ in range(600):
            engine.collect(0.5)
            assert engine.room == 0, "nothing is played there"
    assert notes


def test_no_cluster_and_no_ray(synthetic, ours, monkeypatch):
    engine = RayEngine(synthetic.play, ours, "127.0.0.1:1")
    monkeypatch.setenv("RAY_gcs_rpc_server_connect_timeout_s", "1")
    monkeypatch.setattr(ray, "init", _refusing)
    with pytest.raises(
        UserError, match=r"no Ray cluster answers at '127.0.0.1:1' \(nobody is there\); start one with ray"
    ):
        engine.__enter__()
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    with pytest.raises(UserError, match=r"needs Ray: pip install 'tab-marl\[ray\]'"):
        RayEngine(synthetic.play, ours)


def _refusing(*_, **__):
    raise ConnectionError("nobody is there\nat all")


def test_policies_outside_the_package_travel_as_bytes(tmp_path):
    mine = tmp_path / "home" / "mine"
    mine.mkdir(parents=True)
    (mine / "card.json").write_bytes(b"{}")
    (mine / "weights.safetensors").write_bytes(bytes(range(256)))
    parcel = pack((str(mine), "direct", "scripted"))
    assert list(parcel) == [str(mine)], "what ships with the package does not travel"
    for path in mine.iterdir():
        path.unlink()
    there = Unpacked(parcel)
    job = Job(Unit("M1", "point", 0), ("random",), 1, None, (str(mine), "direct"), "default")
    folder, shipped = there.localised(job).adversaries
    assert shipped == "direct" and folder != str(mine) and Path(folder).name == "mine"
    assert (Path(folder) / "weights.safetensors").read_bytes() == bytes(range(256))
    there.clean()
    assert not Path(folder).exists()
    assert Unpacked({}).localised(job) == job
