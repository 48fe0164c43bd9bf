"""``gripmon run``: the daemon."""

from __future__ import annotations

from gripmon.cli.common import Arguments, Command, positive_number
from gripmon.model.stopping import signals_exit

VIEW = {"nargs": "?", "const": "auto", "choices": ("auto", "web", "native", "server")}
VIEW_OPTION = """
--view  watch it live in rerun's viewer, on this machine: native (a window), web (a page whose address is said),
        auto (native where there is a display), or server (only the stream that viewers connect to)
"""

_OPTIONS = f"""
CONFIG         configuration file (YAML)
--duration S   stop after so many seconds (s); default: never
--out DIR      put the recording and estimates.jsonl (one JSON line a frame; spots.jsonl, a line a pulse) here; made if
               it is missing, and what is there is kept (estimates-1.jsonl …) within daemon.estimates_budget_bytes
--fresh-state  start from the configured reference; a kept state is set aside as <file>.replaced-<n>
--take-over    start also where another monitor of this robot and camera is on the network; nothing is usable until
               one of the two is stopped
{VIEW_OPTION.strip()}
--verbose      say more on stderr
--log-json     one JSON object a line on stderr: time, level, logger, text (for log collectors)
"""

_EXAMPLES = """\
  gripmon run configs/live_camera.yaml
  gripmon run configs/demo.yaml --duration 60 --out results

  gripmon run configs/live_camera.yaml --fresh-state     begin again; the kept state is set aside
  gripmon send undo --robot arm1                         back to the reference before
  gripmon run configs/live_camera.yaml --view web        watch it live in a browser, on this machine

  gripmon run configs/second_camera.yaml                 a fixed camera, watched with a pulsed laser

Messages are on the Zenoh keys gripmon/<robot>/<camera>/{transform,state,alert,reference}; a second
camera's on {spot,state,alert}, and it hears pulses on …/pulse.
exit codes: 0 the source ended, the time was over, or SIGTERM; 2 wrong usage or configuration; 3 no
usable frame, pulses of which none showed its spot, or an internal error that persisted; 4 another
monitor of this robot and camera is on the network; 130 Ctrl-C"""


@Command(
    "run", "the daemon: watch a camera, publish and record", _OPTIONS, _EXAMPLES, duration=positive_number, view=VIEW,
)  # fmt: skip
def run(arguments: Arguments) -> int:
    """Watch a camera: correct cam_T_grip in every frame, publish it over Zenoh and record it, until
    interrupted (Ctrl-C or SIGTERM).  A camera that is missing or goes away is tried again for ever, and
    the state on the network says so.

    The references, a proposal and open alerts survive a restart, also kill -9 and a power cut, in the file
    that state.file names: a live camera's in ~/.local/state/gripmon.  After a restart the monitor goes on
    from the last reference, checks in the picture that it still fits, and says so (alert restarted).

    A configuration with a section laser is that of a second camera, beside the robot: its calibration is
    tested with every pulse of a laser pointer on the arm, which the robot's program tells
    (docs/howto/laser.md, Watching).
    """
    with signals_exit() as stop:
        from gripmon.daemon.starting import run_file

        return run_file(
            arguments.config, out=arguments.out, duration_s=arguments.duration, verbose=arguments.verbose,
            log_json=arguments.log_json, fresh_state=arguments.fresh_state, view=arguments.view,
            take_over=arguments.take_over, stop=stop,
        )  # fmt: skip
