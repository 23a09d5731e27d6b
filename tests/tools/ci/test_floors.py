from tools.ci.floors import FLOORS, WHOLE, shortfalls


def test_floors_are_floors() -> None:
    good = dict.fromkeys(FLOORS, 100.0)
    assert shortfalls(WHOLE, good) == []
    name = next(iter(FLOORS))
    assert shortfalls(WHOLE - 1, good | {name: 10.0})[1].startswith(name)
    del good[name]
    assert len(shortfalls(100.0, good)) == 1
