"""Runs commands in forks of one warm process, and wounds them: reads and answers a line of JSON at a time.

An order is a list of runs that begin together: {"arguments": [...], "kill_after_s": null, "file_bytes": null}. The
answer is a list of {"status", "seconds", "said"}; status -9 is one that was killed, its workers with it.
"""

import json
import os
import resource
import signal
import sys
import time
from contextlib import suppress

import torchfovea.commands.benchmark.command
import torchfovea.commands.reproduce.command
import torchfovea.commands.search.command
import torchfovea.commands.tune.command
from torchfovea.cli import main

STARTED = (
    torchfovea.commands.benchmark.command,
    torchfovea.commands.reproduce.command,
    torchfovea.commands.search.command,
    torchfovea.commands.tune.command,
)


def begin(run):
    """The process's number, and where what it says can be read; no file, which could be full, too."""
    said, speaks = os.pipe()
    os.set_blocking(said, False)
    pid = os.fork()
    if pid == 0:
        os.setpgid(0, 0)
        for stream in (1, 2):
            os.dup2(speaks, stream)
        if run.get("file_bytes") is not None:  # a disk with no space left, as far as files go
            resource.setrlimit(resource.RLIMIT_FSIZE, (run["file_bytes"], resource.RLIM_INFINITY))
        status = 70
        try:
            status = main(run["arguments"])
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(status)
    os.close(speaks)
    return pid, said


def heard(said):
    with suppress(BlockingIOError):
        while part := os.read(said, 2**16):
            yield part.decode("utf-8", "replace")


def carry_out(order):
    runs = [{**run, "started": time.monotonic(), "begun": begin(run), "heard": []} for run in order]
    answers = [None] * len(runs)
    while None in answers:
        for k, run in enumerate(runs):
            if answers[k] is not None:
                continue
            pid, said = run["begun"]
            seconds, after = time.monotonic() - run["started"], run.get("kill_after_s")
            done, code = os.waitpid(pid, os.WNOHANG)
            run["heard"] += heard(said)
            if done:
                os.close(said)
                answers[k] = {
                    "status": os.waitstatus_to_exitcode(code),
                    "seconds": seconds,
                    "said": "".join(run["heard"]),
                }
            elif after is not None and seconds > after:
                os.killpg(pid, signal.SIGKILL)
                run["kill_after_s"] = None
        time.sleep(0.002)
    return answers


if __name__ == "__main__":
    answers_to = os.fdopen(os.dup(1), "w")
    for line in sys.stdin:
        print(json.dumps(carry_out(json.loads(line))), file=answers_to, flush=True)
