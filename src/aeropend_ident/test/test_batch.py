# SPDX-License-Identifier: Apache-2.0
"""Many rigs: one verdict each, the same one whoever does the work, and one bad recording stops no other."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ET

import distributed
import numpy as np
import pytest
from commands import Command

from aeropend_ident.commands import diagnose
from aeropend_ident.diagnosis import batch, dask_cluster
from aeropend_ident.result_folder import folder_names
from aeropend_ident.testing.rigs import BENCH, drawn_rig, steps
from aeropend_sim.model import rig

RIGS = {"monday/run": {}, "tuesday/run": {"coulomb_friction": {}}, "third": {"brush_drop": {}}}
FOLDERS = ["monday_run", "tuesday_run", "third"]


COMMAND = Command("aeropend_ident.commands.diagnose")
command, run = COMMAND.line, COMMAND.run


@pytest.fixture
def here(capsys):
    """Run the command in this process: exit code, standard output, standard error."""
    def run_here(*arguments):
        try:
            code = diagnose.main([str(word) for word in arguments])
        except SystemExit as ended:
            code = ended.code
        return code, *capsys.readouterr()

    return run_here


@pytest.fixture(scope="module")
def recordings(bags, tmp_path_factory):
    """Recordings of three rigs, two of them of the same name; one that is no recording, and one that is not there."""
    folder = tmp_path_factory.mktemp("rigs")
    paths = []
    for seed, (name, effects) in enumerate(RIGS.items(), 20):
        duty = steps(10.0, seed)
        columns, _ = rig.record(drawn_rig(seed, effects), duty, seed)
        (folder / name).parent.mkdir(exist_ok=True)
        paths.append(bags.write(folder / name, bags.content(len(duty), columns={**columns, "duty": duty})))
    (folder / "empty").mkdir()
    return [*paths[:1], folder / "empty", folder / "gone", *paths[1:]]


@pytest.fixture(scope="module")
def alone(recordings, tmp_path_factory):
    """What one process makes of them: the folder, and what it said."""
    out = tmp_path_factory.mktemp("alone") / "out"
    result = COMMAND.here("--each", *recordings, "--out", out, "--jobs", 1)
    assert result.returncode == 0, result.stderr
    return out, result


@pytest.fixture(scope="module")
def cluster():
    """A Dask cluster on this machine: two processes with two threads each."""
    with distributed.LocalCluster(n_workers=2, threads_per_worker=2, processes=True, dashboard_address=":0") as made:
        yield made


def verdicts(out):
    """Everything found, without what differs from run to run by its nature."""
    found = {}
    for folder in FOLDERS:
        body = json.loads((out / folder / "diagnosis.json").read_text())
        assert body.pop("seconds") > 0.0
        model = [line for line in (out / folder / "augmented.yaml").read_text().splitlines() if line[0] != "#"]
        found[folder] = body, model
    return found


def summary(out):
    with (out / batch.SUMMARY).open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.promise("Verdict", "`--each` gives each rig its verdict; processes, Dask and threads do not change it")
def test_every_rig_gets_its_verdict_and_what_cannot_be_used_its_reason(alone, recordings):
    out, result = alone
    assert result.stderr == ""
    rows = summary(out)
    assert [row["recording"] for row in rows] == [str(bag) for bag in recordings]
    used = [row for row in rows if not row["error"]]
    assert [row["folder"] for row in used] == FOLDERS
    assert [row["verdict"] for row in used] == ["none", "coulomb_friction", "brush_drop"]
    assert [row["place"] for row in used][1:] == ["arm", "electrical"]
    for row in used:
        body = json.loads((out / row["folder"] / "diagnosis.json").read_text())
        assert body["bags"] == [row["recording"]]
        assert row["effects"].split() == body["which"]["effects"]
        assert float(row["closed"]) == body["shrink"]["closed"]
        assert (float(row["seconds"]), float(row["gap"])) == (body["seconds"], body["shrink"]["gap"])
        assert sorted(path.name for path in (out / row["folder"]).iterdir()) == [
            "augmented.yaml", "diagnosis.json", "report.html"]
    refused = [row for row in rows if row["error"]]
    assert [("empty" in refused[0]["error"], "gone" in refused[1]["error"])] == [(True, True)]
    assert not any(row["verdict"] or row["folder"] for row in refused)
    assert sorted(path.name for path in out.iterdir()) == sorted([*FOLDERS, batch.SUMMARY])
    table = result.stdout.splitlines()
    assert sum("cannot tell" in line for line in table) == 2
    assert [line.split()[1] for line in table if str(recordings[3]) in line] == ["coulomb_friction"]
    assert table[-1].startswith("3 of 5 diagnosed")


@pytest.mark.promise("Verdict", "`--each` gives each rig its verdict; processes, Dask and threads do not change it")
def test_processes_find_the_same_to_the_last_bit(alone, recordings, tmp_path):
    result = run("--each", *recordings, "--out", tmp_path / "out", "--jobs", 2, "--junit", tmp_path / "verdicts.xml",
                 "--fail-on", "coulomb_friction>20%", "--fail-on", "unknown")
    assert (result.returncode, result.stderr) == (1, "")
    assert verdicts(tmp_path / "out") == verdicts(alone[0])
    last = result.stdout.splitlines()[-1]
    assert last.startswith(f"check: failed, 1 of 6 rules broken: {recordings[3]}: coulomb_friction>20% (it is ")
    assert last.endswith("; 2 without a verdict")
    (suite,) = ET.parse(tmp_path / "verdicts.xml").getroot()
    assert [suite.get(name) for name in ("tests", "failures", "errors")] == ["10", "1", "4"]
    assert [case.get("classname") for case in suite if case.find("failure") is not None] == [str(recordings[3])]


@pytest.mark.promise("Verdict", "`--each` gives each rig its verdict; processes, Dask and threads do not change it")
def test_a_dask_cluster_finds_the_same_to_the_last_bit(alone, recordings, cluster, tmp_path):
    result = run("--each", *recordings, "--out", tmp_path / "out", "--dask", cluster.scheduler_address)
    assert (result.returncode, result.stderr) == (0, "")
    assert verdicts(tmp_path / "out") == verdicts(alone[0])
    assert [row["error"] for row in summary(tmp_path / "out")] == [row["error"] for row in summary(alone[0])]


def test_the_command_in_the_report_gives_the_same_verdict(alone, recordings, tmp_path):
    out, _ = alone
    head = (out / "third" / "augmented.yaml").read_text().splitlines()[0]
    words = head.removeprefix("# ").split()
    assert words[0] == "diagnose"
    words[words.index("--out") + 1] = tmp_path / "out"
    result = COMMAND.here(*words[1:])
    assert result.returncode == 0, result.stderr
    body = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    body.pop("seconds")
    assert body == verdicts(out)["third"][0]


def test_where_nothing_can_be_used_the_exit_code_is_2(recordings, here, tmp_path):
    code, _, complained = here("--each", *recordings[1:3], "--out", tmp_path / "out", "--jobs", 1)
    assert code == 2
    assert complained == f"diagnose: none of the 2 recordings can be used; {tmp_path}/out/summary.csv says why\n"
    assert all(row["error"] for row in summary(tmp_path / "out"))
    code, _, complained = here("--each", recordings[2], "--out", tmp_path / "one", "--jobs", 1)
    assert (code, complained) == (2, f"diagnose: {recordings[2]}: no such file or folder\n")


def test_a_fault_in_one_recording_is_told_and_loses_no_other(here, recordings, bags, tmp_path, monkeypatch):
    whole = batch.diagnose

    def faulty(model, signals, *arguments, **options):
        if len(signals[0]) < len(steps(8.0, 0)):
            raise np.linalg.LinAlgError("Singular matrix")
        return whole(model, signals, *arguments, **options)

    duty = steps(7.0, 5)
    columns, _ = rig.record(drawn_rig(5, {}), duty, 5)
    short = bags.write(tmp_path / "short", bags.content(len(duty), columns={**columns, "duty": duty}))
    monkeypatch.setattr(batch, "diagnose", faulty)
    code, out, err = here("--each", short, recordings[0], "--out", tmp_path / "out", "--jobs", 1)
    assert (code, err) == (0, "")
    told, done = summary(tmp_path / "out")
    assert "LinAlgError: Singular matrix" in told["error"]
    assert done["verdict"] == "none"
    assert out.splitlines()[-1].startswith("1 of 2 diagnosed")


@pytest.mark.parametrize("there", ["third/report.html", "summary.csv"])
def test_nothing_is_overwritten_unasked(recordings, here, tmp_path, there):
    (tmp_path / there).parent.mkdir(exist_ok=True)
    (tmp_path / there).write_text("mine")
    code, said, complained = here("--each", *recordings, "--out", tmp_path)
    assert (code, said, complained.count("\n")) == (2, "", 1)
    assert "--overwrite" in complained
    assert (tmp_path / there).read_text() == "mine"
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(("arguments", "words"), [
    (["BAG", "--dask", "tcp://127.0.0.1:9"], "--each"),
    (["--each", "BAG", "--dask", "tcp://127.0.0.1:9", "--jobs", "2"], "--jobs"),
    (["--each", "BAG", "--dask", "somewhere"], "somewhere"),
    (["--each", "BAG", "--model", "bemch"], "bemch"),
])
def test_a_wrong_command_line_is_one_line(recordings, here, tmp_path, arguments, words):
    code, said, complained = here(*[recordings[0] if word == "BAG" else word for word in arguments],
                                  "--out", tmp_path / "out")
    assert (code, said, complained.count("\n")) == (2, "", 1)
    assert words in complained
    assert not (tmp_path / "out").exists()


def test_without_dask_one_line_says_how_to_get_it(recordings, here, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)  # as where it is not installed
    code, _, complained = here("--each", recordings[0], "--out", tmp_path / "out", "--dask", "tcp://127.0.0.1:9")
    assert (code, complained.count("\n")) == (2, 1)
    assert "pip install 'aeropend_ident[dask]'" in complained


def test_a_scheduler_that_does_not_answer_or_has_no_worker_is_said(monkeypatch):
    monkeypatch.setattr(dask_cluster, "ANSWER_WITHIN", 1.0)
    with pytest.raises(dask_cluster.ClusterError, match="nothing answers there"), dask_cluster.cluster("tcp://127.0.0.1:9"):
        pass
    with (distributed.LocalCluster(n_workers=0, dashboard_address=":0") as empty,
          pytest.raises(dask_cluster.ClusterError, match="no worker"), dask_cluster.cluster(empty.scheduler_address)):
        pass


def deadly():
    """Kills the process that is to work on it, and goes through others unharmed."""
    class Deadly:  # defined in a function, so that processes get it by value
        def __reduce__(self):
            return die_or_be, ()

    def die_or_be():
        import multiprocessing
        import os
        return os._exit(1) if multiprocessing.parent_process() else Deadly()

    return Deadly()


def test_a_killed_process_is_said_and_waited_for_by_nobody(recordings):
    settings = batch.Settings(BENCH, deadly())
    outcomes = list(batch.diagnose_each([str(recordings[0])] * 2, ["", ""], settings, jobs=2))
    assert [(o.results, dask_cluster.KILLED in o.error) for o in outcomes] == [(None, True)] * 2


def test_a_killed_worker_of_a_cluster_is_said_and_the_next_recording_done(recordings, cluster):
    with dask_cluster.cluster(cluster.scheduler_address) as client:
        killed = list(batch.diagnose_each([str(recordings[0])], [""], batch.Settings(BENCH, deadly()), client=client))
        next_one = list(batch.diagnose_each([str(recordings[0])], [""], batch.Settings(BENCH, "bench"), client=client))
    assert killed[0].results is None
    assert dask_cluster.KILLED in killed[0].error
    assert next_one[0].error == ""


def test_an_interrupt_keeps_what_is_done(recordings, tmp_path):
    out = tmp_path / "out"
    with subprocess.Popen(command("--each", *[recordings[0]] * 20, "--out", out, "--jobs", 2), text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True) as process:
        until = time.monotonic() + 100.0
        while not (out / "run" / "augmented.yaml").exists() and time.monotonic() < until:
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGINT)  # as the terminal does
        said, complained = process.communicate(timeout=60)
    assert (process.returncode, said) == (130, "")
    assert len(complained.splitlines()) == 1, complained
    folders = sorted(path.name for path in out.iterdir())
    assert f"{len(folders)} of 20 verdicts are in" in complained
    assert all(len(list((out / name).iterdir())) == 3 for name in folders)


def test_an_interrupt_between_two_recordings_ends_the_work_at_once(here, recordings, tmp_path, monkeypatch):
    """Left to garbage collection, which may come in a thread that waits for them, the processes would never end."""
    begun, real = [], batch.diagnose_each

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    def kept(*arguments):
        begun.append(real(*arguments))  # nothing that is held is garbage
        return begun[0]

    monkeypatch.setattr(batch, "diagnose_each", kept)
    monkeypatch.setattr(batch, "row", interrupt)
    code, _, complained = here("--each", recordings[0], recordings[0], "--out", tmp_path / "out", "--jobs", 1)
    assert (code, complained) == (130, f"diagnose: interrupted; 1 of 2 verdicts are in {tmp_path / 'out'}\n")
    assert begun[0].gi_frame is None


@pytest.mark.parametrize(("at", "line"), [("diagnose_each", "interrupted, nothing was written"),
                                         ("row", "interrupted; 1 of 2 verdicts are in OUT")])
def test_an_interrupt_counts_no_verdict_that_was_there_before(here, recordings, tmp_path, monkeypatch, at, line):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    for name in ("run", "run_2"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "diagnosis.json").write_text("old")
    monkeypatch.setattr(batch, at, interrupt)
    code, _, complained = here("--each", *recordings[:1] * 2, "--out", tmp_path, "--jobs", 1, "--overwrite")
    assert (code, complained) == (130, f"diagnose: {line.replace('OUT', str(tmp_path))}\n")


@pytest.mark.parametrize(("bags", "names"), [
    (["a", "b/c", "d.mcap", "e.1"], ["a", "c", "d", "e.1"]),
    (["x/run", "y/run", "z"], ["x_run", "y_run", "z"]),
    (["x/1/run", "y/1/run", "y/2/run"], ["x_1_run", "y_1_run", "2_run"]),
    (["run", "run", "./run"], ["run", "run_2", "run_3"]),
    (["run", "run", "run_2"], ["run", "run_2", "run_2_2"]),
    (["summary.csv"], ["summary.csv_2"]),
])
def test_folders_have_the_names_of_the_recordings_and_are_all_different(bags, names):
    assert folder_names(bags, [batch.SUMMARY]) == names
