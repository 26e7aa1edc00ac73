from __future__ import annotations

from pathlib import Path

import pytest

from airl_mav.core.errors import UsageError
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.loading import list_profiles

HEAD = """
description = "d"
cpu = "c"
watts = 5.0
price_usd = 100.0
source = "s"
[workloads.w]
source = "bench"
[workloads.w.network]
image_height_px = 48
image_width_px = 64
parameters = 1000
macs = 2000
runtime = "onnxruntime"
[workloads.w.latency]
"""


def write(folder: Path, latency: str) -> str:
    path = folder / "mine.toml"
    path.write_text(HEAD + latency, encoding="utf-8")
    return str(path)


@pytest.mark.parametrize(
    ("computer", "workload", "mean_ms"),
    [
        ("ras-pi-4", "template-5x32", 396.0),
        ("ras-pi-4", "template-4x48", 542.28),
        ("ras-pi-4", "template-7x32", 948.92),
        ("workstation", "template-5x32", 11.0),
        ("workstation", "template-4x48", 10.0),
        ("workstation", "template-7x32", 9.3),
        ("workstation", "degraded-150", 150.0),
        ("workstation", "degraded-300", 300.0),
    ],
)
def test_latencies_are_those_of_the_papers_tables(
    computer: str, workload: str, mean_ms: float
) -> None:
    assert load_computer(computer).workloads[workload].latency.mean_ms == mean_ms


def test_power_and_price_are_those_of_the_papers_table() -> None:
    pi, i9 = load_computer("ras-pi-4"), load_computer("workstation")
    assert (pi.watts, pi.price_usd) == (1.7, 75.0)
    assert (i9.watts, i9.price_usd) == (350.0, 1500.0)


def count_template(layers: int, filters: int, height: int, width: int) -> tuple[int, int]:
    """Walk the paper's template layer by layer: 3x3 same convolutions, dense layers, 25 outputs."""
    parameters = macs = 0
    channels = 1
    for _ in range(layers):
        kernel = 3 * 3 * channels * filters
        parameters += kernel + filters
        macs += kernel * height * width
        channels = filters
    units = height * width * filters + 6
    for out in [*[filters] * layers, 25]:
        parameters += units * out + out
        macs += units * out
        units = out
    return parameters, macs


@pytest.mark.parametrize("computer", list_profiles("computers"))
def test_networks_have_the_size_they_state(computer: str) -> None:
    for work in load_computer(computer).workloads.values():
        net = work.network
        assert net.layers is not None
        assert net.filters is not None
        counted = count_template(net.layers, net.filters, net.image_height_px, net.image_width_px)
        assert (net.parameters, net.macs) == counted


def test_the_count_agrees_with_the_papers_40_3_million() -> None:
    assert count_template(5, 32, 154, 256)[0] / 1e6 == pytest.approx(40.3, abs=0.2)


@pytest.mark.parametrize("computer", list_profiles("computers"))
def test_every_workload_says_where_it_comes_from_and_what_is_assumed(computer: str) -> None:
    for work in load_computer(computer).workloads.values():
        assert "Air Learning" in work.source
        assert "spread" in work.assumed


@pytest.mark.parametrize(
    ("latency", "message"),
    [
        ('distribution = "lognormal"', "needs mean_ms"),
        ('distribution = "lognormal"\nmean_ms = 10.0', "needs std_ms"),
        ('distribution = "fixed"\nmean_ms = 10.0\nstd_ms = 1.0', "'fixed' has no spread"),
        ('distribution = "lognormal"\nmean_ms = 0.0\nstd_ms = 1.0', "0 < value <= 60000 ms"),
        (
            'distribution = "lognormal"\nmean_ms = 5.0\nstd_ms = 1.0\nmin_ms = 6.0',
            "accepted: below mean_ms 5",
        ),
        ('distribution = "samples"', "one of samples_ms, samples_file"),
        ('distribution = "samples"\nsamples_ms = []', "one value or more"),
        ('distribution = "samples"\nsamples_ms = [1.0]\nmean_ms = 1.0', "leave them out"),
        ('distribution = "fixed"\nmean_ms = 1.0\nsamples_ms = [1.0]', "do not go with"),
        ('distribution = "gamma"\nmean_ms = 1.0', "workloads.w.latency.distribution"),
        ('distribution = "fixed"\nmean = 1.0', "did you mean 'mean_ms'?"),
    ],
)
def test_a_wrong_latency_gets_one_clear_line(tmp_path: Path, latency: str, message: str) -> None:
    path = write(tmp_path, latency)
    with pytest.raises(UsageError) as error:
        load_computer(path)
    assert message in str(error.value)
    assert str(error.value).startswith(path)
    assert "\n" not in str(error.value)


def test_samples_file_lies_beside_the_profile(tmp_path: Path) -> None:
    (tmp_path / "laps.txt").write_text("# ms\n10.5\n\n11.25  # a slow one\n", encoding="utf-8")
    path = write(tmp_path, 'distribution = "samples"\nsamples_file = "laps.txt"')
    latency = load_computer(path).workloads["w"].latency
    assert latency.samples_ms == (10.5, 11.25)
    assert latency.samples_file is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "samples_file"),
        ("", "no samples"),
        ("fast\n", "one latency a line"),
        ("1.0\nnan\n", "nan: accepted: 0 < value <= 60000 ms"),
        ("-1.0\n", "-1: accepted"),
    ],
)
def test_a_bad_samples_file_is_refused(tmp_path: Path, text: str | None, message: str) -> None:
    if text is not None:
        (tmp_path / "laps.txt").write_text(text, encoding="utf-8")
    path = write(tmp_path, 'distribution = "samples"\nsamples_file = "laps.txt"')
    with pytest.raises(UsageError, match="laps") as error:
        load_computer(path)
    assert message in str(error.value)
