"""One decision for every command: when a model is worth its error, and when to trace exactly."""

from neurolens.studies.pages import SAVING, recommended, to_use


def test_the_rule_at_its_edge() -> None:
    for cost, rest, use in ((1.0, 0.0, 1.0), (1.001, 0.0, 1.5), (0.9, 0.3, 0.9), (0.95, 0.3, 1.5), (0.0, 3.1, 1.5)):
        assert recommended([cost, 2.0], float, 1.5, rest) == use == recommended([2.0, cost], float, SAVING, rest)
    assert recommended([], float, None) is None and recommended([], float, 3.0) == 3.0
    assert recommended([2.0, 1.0], float, None) == 1.0


def test_without_times_the_smallest_close_model_is_taken_and_else_the_closest() -> None:
    models = [{"name": n, "rms_um": e, "bytes": b} for n, e, b in (("a", 1.0, 9), ("b", 0.1, 20), ("c", 5.0, 1))]
    assert to_use(models) is models[0] and to_use(models, 0.5) is models[1] and to_use(models, 0.01) is models[1]
    assert to_use([]) is None
    poor = [{**models[0], "poor": ["false pass 3%"]}]
    exact = {"name": "exact C", "ns_per_ray": {"min": 50.0}}
    assert to_use(poor) is poor[0] and to_use(poor, exact=exact) is exact
