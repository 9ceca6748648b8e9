"""Child processes that try mutants one by one, with a time limit, and are started again when one dies."""

import faulthandler
import json
import os
import resource
import selectors
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from physgraph_usd.shot.solve import prepare_device

from .trial import Outcome

START_SECONDS = 120.0
"""Time that a child has for its imports."""
MEMORY_BYTES = 3 * 2**30
"""What a child may ask for beyond its imports, three times what the largest mutant needs: a damaged binary layer makes
USD ask for what its counts say."""


def serve(bases: Path, work: Path) -> None:
    """Be a child: read numbers from stdin, try each, write one line of JSON each to what stdout was."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    faulthandler.enable()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    from .kinds import KINDS
    from .trial import attempt

    prepare_device("cpu")
    limit = MEMORY_BYTES + resource.getpagesize() * int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    answers.write("ready\n")
    answers.flush()
    for line in sys.stdin:
        number = int(line)
        answers.write(attempt(number, KINDS, bases, work / str(number)).to_json() + "\n")
        answers.flush()


class Child:
    def __init__(self, bases: Path, work: Path) -> None:
        """Start it; it is ready at the first answer."""
        self._log = work / f"child-{threading.get_ident()}-{time.monotonic_ns()}.log"
        with self._log.open("wb") as log:
            line = [sys.executable, "-m", "tests.fuzz", "--serve", str(bases), str(work)]
            root = Path(__file__).resolve().parents[2]
            self._process = subprocess.Popen(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, cwd=root)
        self._answer(START_SECONDS)

    def attempt(self, number: int, seconds: float) -> Outcome:
        """Try one mutant; a hang or a death is an outcome too, after which the child is of no more use."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{number}\n".encode())
        self._process.stdin.flush()
        line = self._answer(seconds)
        if line is None:
            return Outcome(number, "", "hang", f"no answer in {seconds:g} s\n{self._told()}")
        if not line:
            code = self._process.wait()
            name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
            return Outcome(number, "", "died", f"{name}\n{self._told()}")
        return Outcome(**json.loads(line))

    def _answer(self, seconds: float) -> str | None:
        """A line; "" when the child is gone, None when the time is over."""
        assert self._process.stdout is not None
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            if not selector.select(seconds):
                return None
        return self._process.stdout.readline().decode()

    def _told(self) -> str:
        """The end of its stderr, where a crash has left the Python stack; asks for the stack of one that hangs."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGABRT)
            self._process.wait(10)
        return self._log.read_text(errors="replace")[-4000:]

    def end(self) -> None:
        """Kill it and forget its log."""
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()
        self._log.unlink(missing_ok=True)


def run_all(
    numbers: Sequence[int], bases: Path, work: Path, *, jobs: int, seconds: float, done: Callable[[Outcome], None]
) -> None:
    """Try mutants in child processes; `done` is called with each outcome, by one thread at a time."""
    waiting, lock = list(reversed(numbers)), threading.Lock()

    def attend() -> None:
        child = Child(bases, work)
        while True:
            with lock:
                if not waiting:
                    break
                number = waiting.pop()
            outcome = child.attempt(number, seconds)
            if outcome.result in {"hang", "died"}:
                child.end()
                child = Child(bases, work)
            with lock:
                done(outcome)
        child.end()

    threads = [threading.Thread(target=attend) for _ in range(jobs)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def describe_dead(outcome: Outcome, folder: Path) -> None:
    """Fill in what a child that died could not say, from the note beside the mutant, and look for a partial file."""
    note = folder / "mutant.json"
    if note.is_file():
        told = json.loads(note.read_text())
        outcome.kind, outcome.said = told["kind"], told["said"]
    if (folder / "out.usdc").exists():
        outcome.detail = f"a file was left under the final name\n{outcome.detail}"
    elif "physgraph_usd" in outcome.detail:
        outcome.detail = f"{outcome.detail}\nno file was left under the final name"


def clear(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
