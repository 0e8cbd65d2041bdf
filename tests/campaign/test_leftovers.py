"""Temporary files of workers that were killed while they wrote."""

import os
import time

from wfsobs.campaign.plan import parse_plan
from wfsobs.campaign.store import LEFTOVER, ROWS, batch_files, open_folder, remove_leftovers, write_batch
from wfsobs.files import write_whole


def test_old_ones_are_removed_and_those_of_a_running_share_stay(tmp_path, monkeypatch):
    plan = parse_plan('seeds = 1\nobservers = ["kf-lgs"]\n', tmp_path)
    folder = tmp_path / "out"
    open_folder(plan, folder)

    def killed(source, _path):
        """As SIGKILL: no line of the process runs any more, and the temporary file stays."""
        names.append(source)
        monkeypatch.setattr(os, "unlink", lambda _path: None)
        raise KeyboardInterrupt

    names, replace, unlink = [], os.replace, os.unlink
    for write in (lambda: write_batch(folder, [], {}), lambda: write_whole(folder / "plan.json", lambda file: None)) * 2:
        monkeypatch.setattr(os, "replace", killed)
        try:
            write()
        except KeyboardInterrupt:
            pass
        monkeypatch.setattr(os, "replace", replace)
        monkeypatch.setattr(os, "unlink", unlink)
    write_batch(folder, [], {})
    kept = [folder / ROWS / ".nfs00001", folder / "rows" / ".notes", *batch_files(folder)]
    for path in kept[:2]:
        path.write_bytes(b"of somebody else")
    past = time.time() - LEFTOVER - 60
    for path in [*names[:2], *kept]:
        os.utime(path, (past, past))
    open_folder(plan, folder)  # its plan is written now, by the clock of the file system
    remove_leftovers(folder)
    assert [os.path.exists(path) for path in names] == [False, False, True, True]
    assert all(path.exists() for path in kept)
