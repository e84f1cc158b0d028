"""One point: its columns, that they are those of a run, and what is compiled anew."""

from dataclasses import asdict

import jax
import pytest
from commands.study import tiny
from commands.sweep import mini

from thincam_jax.commands.study.build import build_study
from thincam_jax.commands.sweep.point import measure_point


@pytest.mark.thorough
def test_columns_are_the_metrics_of_a_run(tmp_path):
    targets = tiny.TEXT[tiny.TEXT.index("  - {name: chart") :]
    config = tiny.study(tmp_path, text=mini.TEXT[: mini.TEXT.index("  - {name: star")] + targets)
    (point,) = mini.points(config, "seed=0", double=True)
    measured = measure_point(point.config, point.double)
    assert measured.reason is None
    row = measured.metrics
    assert row is not None
    assert row.pop("seconds") > 0
    expected, study = {}, build_study(config)
    methods = asdict(study.run().scores)["methods"]
    for name, method in methods.items():
        mean = sum(target["psnr_db"] for target in method["targets"].values()) / 2
        expected[f"mean_psnr_db/{name}"] = pytest.approx(mean, abs=1e-4)
        key = "mean_psnr_of_pictures_db"
        expected[f"{key}/{name}"] = method[key]
        for target, metrics in method["targets"].items():
            resolved = metrics.pop("resolved")
            if resolved:
                metrics |= {f"resolved_{inner}": value for inner, value in resolved.items()}
            expected |= {f"{key}/{name}/{target}": value for key, value in metrics.items()}
    assert row == expected
    assert any(name.startswith("mean_psnr_of_pictures_db/") for name in row)


@pytest.mark.thorough
def test_values_of_one_shape_are_compiled_once(tmp_path):
    """Counted by JAX's own events of its compiler."""
    compiled = []

    def listen(event, _, **__):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(event)

    config = mini.study(tmp_path)
    (first,) = mini.points(config, "seed=0")
    beta = mini.points(config, "methods.0.shots.0.beta=15:24:4 rad/mm^2")
    noise = mini.points(config, "noise.snr_db=20:28:3")
    distance = mini.points(config, "methods.0.shots.0.distance=2.99:2.995:2 mm")
    jax.clear_caches()
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        assert measure_point(first.config, False).metrics is not None
        assert compiled
        compiled.clear()
        rows = [measure_point(p.config, False).metrics for p in (*beta, *noise, *distance)]
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert not compiled
    psnr = [row["psnr_db/single/star"] for row in rows if row is not None]
    assert len(set(psnr)) == 9  # they are other points


def test_camera_that_cannot_be_built_is_a_reason(tmp_path):
    (point,) = mini.points(mini.study(tmp_path), "mask.pixel_pitch=0.7 mm")
    measured = measure_point(point.config, False)
    assert measured.metrics is None
    assert measured.reason is not None
    assert measured.reason.startswith("mask, sensor or model: width = 2 mm is not a whole number")
    assert measured.traceback is None


def test_defect_is_a_reason_with_its_traceback(tmp_path, monkeypatch):
    def broken(_):
        raise ZeroDivisionError("a\n  defect")

    monkeypatch.setattr("thincam_jax.commands.sweep.point.build_study", broken)
    (point,) = mini.points(mini.study(tmp_path), "seed=1")
    measured = measure_point(point.config, False)
    assert measured.reason == "ZeroDivisionError: a"
    assert "in broken" in (measured.traceback or "")
