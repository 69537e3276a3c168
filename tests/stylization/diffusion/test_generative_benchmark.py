"""Every pair of the generative stages' choices runs in half precision: the benchmark's own figures."""

import json
import sys

import torch

from tests.support.helpers import ROOT


def test_every_pair_of_choices_runs_in_half_precision(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(ROOT))
    from benchmarks import generative

    threads = torch.get_num_threads()
    words = ["--quick", "--precision", "bfloat16", "--json", str(tmp_path / "x.json")]
    monkeypatch.setattr(sys, "argv", ["generative", *words])
    generative.main()
    torch.set_num_threads(threads)
    figures = json.loads((tmp_path / "x.json").read_text())["figures"]
    assert figures["paths"] == figures["paths_run"] == 8
    stylizers = [name for name in figures if name.split(".")[0] in ("lora", "ip") and not name.endswith(".cpu")]
    assert len(stylizers) == 4 and all("bfloat16" in name for name in stylizers)
