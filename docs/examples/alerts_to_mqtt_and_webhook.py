"""Pass every alert of every monitor on to an MQTT broker, a webhook, or both; as a service beside the router.

Where Prometheus runs anyway, its Alertmanager does webhooks, mail and chat without any program (docs/howto/operate.md).
This one needs neither, hears of an alert at once and not at the next scrape, and passes on the message itself.

``pip install gripmon paho-mqtt``.  To MQTT an alert goes with quality of service 1 to
``gripmon/<robot>/<camera>/alert``, to a webhook as a POST, both as the JSON of the messages' reference.  What can't be
delivered now is tried again, in order, until this ends; 10,000 wait at most, and nothing waits on a disk.  After a
start the last 32 alerts of each monitor come again.
"""

from __future__ import annotations

import argparse
import contextlib
import http.client
import logging
import queue
import threading
import urllib.error
import urllib.request
from collections.abc import Callable

from gripmon.client import Fleet, MonitorName
from gripmon.model.records import AlertRecord

Send = Callable[[MonitorName, bytes], None]
"""Deliver one alert; OSError where that failed, ValueError where it would fail again."""
WAITING_MOST, AGAIN_S, TIMEOUT_S = 10_000, 5.0, 10.0


class Outbox:
    """Alerts on their way to one place, in a thread of its own: a place that is slow holds up no other."""

    def __init__(self, place: str, send: Send) -> None:
        self._place, self._send = place, send
        self._waiting: queue.Queue[tuple[MonitorName, bytes] | None] = queue.Queue(WAITING_MOST)
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def put(self, monitor: MonitorName, payload: bytes) -> None:
        """Never waits: it is called in Zenoh's threads."""
        try:
            self._waiting.put_nowait((monitor, payload))
        except queue.Full:
            logging.error("%s: %d alerts wait; one of %s is lost", self._place, WAITING_MOST, monitor)

    def close(self) -> None:
        """What still waits is not delivered any more."""
        self._ends.set()
        with contextlib.suppress(queue.Full):
            self._waiting.put_nowait(None)
        self._thread.join()

    def _run(self) -> None:
        while (waiting := self._waiting.get()) is not None:
            while not self._ends.is_set():
                try:
                    self._send(*waiting)
                    break
                except OSError as error:
                    logging.warning("%s: %s; trying again", self._place, error)
                    self._ends.wait(AGAIN_S)
                except ValueError as error:
                    logging.error("%s: an alert of %s is left out: %s", self._place, waiting[0], error)
                    break
            else:
                logging.warning("%s: %d alerts were not delivered", self._place, self._waiting.qsize())
                return


def to_webhook(url: str) -> Send:
    """POST it; whatever answers 4xx (but 408 and 429) doesn't want this alert, and any other failure may pass."""

    def send(monitor: MonitorName, payload: bytes) -> None:
        request = urllib.request.Request(url, payload, {"Content-Type": "application/json"})
        try:
            urllib.request.urlopen(request, timeout=TIMEOUT_S).close()
        except urllib.error.HTTPError as error:
            if 400 <= error.code < 500 and error.code not in (408, 429):
                raise ValueError(f"the webhook answers {error.code}") from None
            raise
        except http.client.HTTPException as error:
            raise OSError(f"{type(error).__name__} {error}") from None

    return send


def to_mqtt(host: str, port: int) -> Send:
    """Publish it, and wait until the broker has it."""
    import paho.mqtt.client as mqtt

    client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
    client.on_connect = lambda _client, _data, _flags, why, _properties: logging.info("%s:%d: %s", host, port, why)
    client.connect_async(host, port)
    client.loop_start()  # it also connects again

    def send(monitor: MonitorName, payload: bytes) -> None:
        if not client.is_connected():
            raise OSError(f"no connection to {host}:{port}")
        message = client.publish(f"gripmon/{monitor.robot}/{monitor.camera}/alert", payload, qos=1)
        try:
            message.wait_for_publish(TIMEOUT_S)
        except RuntimeError as error:
            raise OSError(f"{host}:{port}: {error}") from None
        if not message.is_published():
            raise OSError(f"{host}:{port} has not taken it within {TIMEOUT_S:g} s")

    return send


def main() -> None:
    """Until Ctrl-C."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", help="a monitor's or a router's Zenoh endpoint")
    parser.add_argument("--zenoh-config", help="a configuration file of Zenoh's instead")
    parser.add_argument("--webhook", action="append", default=[], metavar="URL")
    parser.add_argument("--mqtt", action="append", default=[], metavar="HOST:PORT")
    given = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    boxes = [Outbox(url, to_webhook(url)) for url in given.webhook]
    for place in given.mqtt:
        host, _, port = place.rpartition(":")
        boxes.append(Outbox(place, to_mqtt(host, int(port))))
    if not boxes:
        parser.error("nowhere to go: --webhook or --mqtt")

    def take(monitor: MonitorName, alert: AlertRecord, payload: bytes) -> None:
        for box in boxes:
            box.put(monitor, payload)

    try:
        with Fleet(connect=given.connect, zenoh_config_file=given.zenoh_config, on_alert=take):
            logging.info("waiting for alerts at %s", given.zenoh_config or given.connect)
            threading.Event().wait()
    except KeyboardInterrupt:
        pass
    finally:
        for box in boxes:
            box.close()


if __name__ == "__main__":
    main()
