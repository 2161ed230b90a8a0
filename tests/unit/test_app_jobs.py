"""Work in the background, its results in the foreground."""

import threading

import pytest
from cap4d.app.jobs import Jobs


@pytest.fixture
def jobs():
    errors = []
    made = Jobs(errors.append)
    made.errors = errors
    yield made
    made.close()


def finish(jobs):
    finished = False
    while jobs.label is not None:
        jobs._executor.submit(lambda: None).result(10)  # one worker: what was begun before is through
        finished |= jobs.poll()
    return finished


def test_work_is_done_elsewhere_and_its_result_taken_over_here(jobs):
    threads, results = [], []
    jobs.start("a", lambda: threads.append(threading.current_thread()) or 7, results.append)
    assert jobs.label == "a"
    assert results == []
    assert finish(jobs)
    assert results == [7]
    assert threads != [threading.current_thread()]
    assert jobs.label is None
    assert not jobs.poll()


def test_results_come_in_the_order_of_the_work(jobs):
    results, gate = [], threading.Event()
    jobs.start("slow", lambda: gate.wait(10), lambda _: results.append("slow"))
    jobs.start("quick", lambda: None, lambda _: results.append("quick"))
    assert not jobs.poll()
    gate.set()
    finish(jobs)
    assert results == ["slow", "quick"]


def test_work_begins_when_the_result_before_it_is_taken_over(jobs):
    known = []
    jobs.start("first", lambda: 1, known.append)
    jobs.start("second", lambda: list(known), known.append)
    finish(jobs)
    assert known == [1, [1]]


def test_what_goes_wrong_is_told_and_the_rest_goes_on(jobs):
    def broken(*_):
        raise ValueError("broken")

    results = []
    jobs.start("work", broken, results.append)
    jobs.start("done", lambda: 1, broken)
    jobs.start("fine", lambda: 2, results.append)
    finish(jobs)
    assert [str(e) for e in jobs.errors] == ["broken", "broken"]
    assert results == [2]


def test_closing_does_what_must_be_done_and_nothing_else():
    blocked, done = threading.Event(), []
    jobs = Jobs(lambda error: None)
    jobs.start("load", blocked.wait, lambda _: None)
    jobs.start("look", lambda: done.append("look"), lambda _: None)
    jobs.start("finish", lambda: done.append("finish"), lambda _: None, must_be_done=True)
    blocked.set()
    jobs.close()
    assert done == ["finish"]
