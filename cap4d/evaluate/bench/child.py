"""Measurements in a process of their own: another instruction set, or memory that nothing else has touched.

echo '{"task": "splat", ...}' | python -m cap4d.evaluate.bench.child
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

from cap4d.errors import Cap4dError

TIMEOUT_S = 600


class ChildError(Cap4dError):
    """The other process failed; the text is the last line it wrote."""


def in_child(task: str, *, environment: dict[str, str] | None = None, **arguments: Any) -> dict[str, Any]:
    """Runs one of `TASKS` in a fresh process.

    Args:
        environment: Variables to set there, e.g. CAP4D_ISA.
        arguments: Of the task; what JSON can carry.
    Raises:
        ChildError: It failed.
    """
    done = subprocess.run(
        [sys.executable, "-m", "cap4d.evaluate.bench.child"],
        input=json.dumps({"task": task, **arguments}),
        env={**os.environ, **(environment or {})},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )
    if done.returncode:
        raise ChildError((done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1])
    return json.loads(done.stdout.splitlines()[-1])


def splat_task(**arguments: Any) -> dict[str, Any]:
    from cap4d.evaluate.bench.scaling import measure_alone

    return measure_alone(**arguments)


def memory_task(**arguments: Any) -> dict[str, Any]:
    from cap4d.evaluate.bench.splatting import memory_alone

    return memory_alone(**arguments)


def frame_task(**arguments: Any) -> dict[str, Any]:
    from cap4d.evaluate.bench.frames import memory_alone

    return memory_alone(**arguments)


def iteration_task(**arguments: Any) -> dict[str, Any]:
    from cap4d.evaluate.bench.iteration import memory_alone

    return memory_alone(**arguments)


TASKS: dict[str, Callable[..., dict[str, Any]]] = {
    "splat": splat_task,
    "memory": memory_task,
    "frame": frame_task,
    "iteration": iteration_task,
}


def main() -> None:
    arguments = json.load(sys.stdin)
    print(json.dumps(TASKS[arguments.pop("task")](**arguments)))


if __name__ == "__main__":
    main()
