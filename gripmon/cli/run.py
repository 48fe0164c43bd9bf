"""``gripmon run``: the daemon."""

from __future__ import annotations

from gripmon.cli.common import Arguments, Command, positive_number
from gripmon.model.stopping import signals_exit

VIEW = {"nargs": "?", "const": "auto", "choices": ("auto", "web", "native", "server")}
VIEW_OPTION = """
--view  show it live in rerun's viewer, on this machine: native (a window), web (a page whose address is printed),
        auto (native if there is a display), or server (only the stream that viewers connect to)
"""

_OPTIONS = f"""
CONFIG         configuration file (YAML)
--duration S   stop after this time (s); default: never
--out DIR      folder for the recording and estimates.jsonl (one JSON line per frame);
               created if missing; existing files are kept (estimates-1.jsonl …) within daemon.estimates_budget_bytes
--fresh-state  start from the configured reference; a kept state is set aside as <file>.replaced-<n>
--take-over    start even if another monitor of this robot and camera is on the network; nothing is usable until
               one of the two is stopped
{VIEW_OPTION.strip()}
--verbose      log more on stderr
--log-json     one JSON object per line on stderr: time, level, logger, text (for log collectors)
"""

_EXAMPLES = """\
  gripmon run configs/live_camera.yaml
  gripmon run configs/demo.yaml --duration 60 --out results

  gripmon run configs/live_camera.yaml --fresh-state     start again; the kept state is set aside
  gripmon send undo --robot arm1                         back to the previous reference
  gripmon run configs/live_camera.yaml --view web        show it live in a browser, on this machine


Messages are on the Zenoh keys gripmon/<robot>/<camera>/{transform,state,alert,reference}.
exit codes: 0 the source ended, the time was over, or SIGTERM; 2 wrong usage or configuration; 3 no
usable frame, or an internal error that persisted; 4 another
monitor of this robot and camera is on the network; 130 Ctrl-C"""


@Command(
    _OPTIONS, _EXAMPLES, duration=positive_number, view=VIEW,
)  # fmt: skip
def run(arguments: Arguments) -> int:
    """Monitor a camera: correct cam_T_grip in every frame, publish it over Zenoh and record it, until
    interrupted (Ctrl-C or SIGTERM).  If the camera is missing or disappears, the monitor retries forever
    and reports it in the state.

    The references, a proposal and open alerts survive a restart, also kill -9 and a power cut, in the file
    that state.file names: for a live camera in ~/.local/state/gripmon.  After a restart the monitor
    continues from the last reference, checks that the image fits it, and reports this (alert restarted).

    """
    with signals_exit() as stop:
        from gripmon.daemon.starting import run_file

        return run_file(
            arguments.config, out=arguments.out, duration_s=arguments.duration, verbose=arguments.verbose,
            log_json=arguments.log_json, fresh_state=arguments.fresh_state, view=arguments.view,
            take_over=arguments.take_over, stop=stop,
        )  # fmt: skip
