"""The reception alone: who takes the reports of a wire, what is refused, and which silence is an alarm."""

import pytest
from tests.live.conftest import START_S

from sameas.errors import InputError
from sameas.io.sensors.nmea import checksum
from sameas.live.reception import PAUSES, Reception
from sameas.live.replay import Replay
from sameas.live.settings import LiveSource, Settings, WatchSettings, read_settings
from sameas.tracks import Description
from sameas.tracks.platforms import OWN_POSITIONS
from sameas.tracks.reports import Reports

URL = "udp://127.0.0.1:60004"


class Receiver:
    """A reception of two sources on one wire, its clock, and what was taken."""

    def __init__(self, refuse=False, replay=None, **watch):
        sources = {
            name: LiveSource(Description(name, "tracks"), URL, "table", sensor=name) for name in ("east", "west")
        }
        self.now_s, self.taken, self.refuse = START_S, [], refuse
        settings = Settings(sources, WatchSettings(**watch), {"mast": "mast: has no site"})
        self.reception = Reception(settings, lambda: self.now_s, replay=replay, use=self.use)

    def use(self, name, reports):
        if self.refuse:
            raise InputError(f"{name}: no site", "give one")
        self.taken.append((name, len(reports)))

    def alarms(self, after_s, excused=()):
        self.now_s += after_s
        self.reception.take(self.now_s)
        return [alarm.key for alarm in self.reception.alarms(excused)]


def at(time_s, n=1):
    return Reports.of("west", "table", {"time_s": [time_s] * n, "x_m": [0.0] * n, "y_m": [0.0] * n})


def test_reports_are_taken_and_those_far_ahead_refused():
    receiver = Receiver()
    receiver.reception.add("west", at(START_S - 3.0, 2), START_S)
    receiver.reception.add("west", at(START_S + 601.0), START_S)
    state = receiver.reception.sources["west"]
    assert receiver.taken == [("west", 2)] and state.refused == 1 and state.delay_s == -601.0


def test_reports_that_cannot_be_used_are_counted_with_the_reason_without_the_name():
    receiver = Receiver(refuse=True)
    receiver.reception.add("west", at(START_S, 3), START_S)
    state = receiver.reception.sources["west"]
    assert (state.refused, state.error) == (3, "no site; give one") and state.last_s == -float("inf")
    receiver.refuse = False
    receiver.reception.add("west", at(START_S), START_S)
    assert state.error == "" and state.last_s == START_S


def test_a_silent_source_is_an_alarm_unless_it_is_excused():
    receiver = Receiver(silent_s=30.0)
    assert receiver.alarms(29.0) == ["set aside mast"]
    assert receiver.alarms(2.0) == ["set aside mast", f"silent {URL}"]
    receiver.reception.wires[URL].state.last_s = receiver.now_s
    receiver.reception.add("west", at(receiver.now_s), receiver.now_s)
    assert receiver.alarms(0.0) == ["set aside mast", "silent east"]
    assert receiver.alarms(0.0, excused={"east"}) == ["set aside mast"]


@pytest.mark.parametrize(("every_s", "pauses"), [(180.0, (170.0, 185.0)), (1.0, (58.0,)), (40.0, (150.0, 195.0))])
def test_a_receiver_of_ships_at_anchor_is_not_silent(every_s, pauses, tmp_path):
    """Where all ships lay at anchor, the receiver of AIS was silent, every three minutes again."""
    path, now = tmp_path / "sensors.toml", [START_S]
    path.write_text(f'[sources.west]\nkind = "ais"\ninput = "{URL}"\n')
    reception = Reception(read_settings(path), lambda: now[0], use=lambda name, reports: None)

    def after(seconds):
        now[0] += seconds
        reception.take(now[0])
        return [alarm.text for alarm in reception.alarms() if alarm.key.startswith("silent")]

    for k in range(12):
        assert not after(every_s if k else 1.0)
        reception.wires[URL].state.last_s = now[0]
        reception.add("west", at(now[0]), now[0])
    waited_s = 0.0
    for pause_s in pauses:
        assert not after(pause_s - waited_s)
        waited_s = pause_s
    [text] = after(PAUSES * every_s + 200.0 - waited_s)
    assert text.startswith("west has sent no report for ")


def test_a_flood_is_an_alarm_each_time_that_more_is_dropped():
    receiver = Receiver()
    queue = receiver.reception.wires[URL].queue
    queue.dropped = 3
    assert f"flood {URL}" in receiver.alarms(1.0) and f"flood {URL}" not in receiver.alarms(1.0)
    queue.dropped = 4
    assert f"flood {URL}" in receiver.alarms(1.0)


def test_a_replay_has_no_wires_and_no_silence():
    receiver = Receiver(replay=Replay([("west", at(START_S, 2)), ("east", at(START_S + 50.0))]), silent_s=30.0)
    assert receiver.reception.wires == {} and receiver.alarms(40.0) == ["set aside mast"]
    assert receiver.taken == [("west", 2)]
    receiver.alarms(10.0)
    assert receiver.taken == [("west", 2), ("east", 1)]


def test_reports_of_a_vessel_are_taken_before_those_of_the_sensors_aboard(tmp_path):
    """In a replay at many times real time those of a minute come together; a plot waits for no position."""
    path = tmp_path / "sensors.toml"
    path.write_text('[sources.arpa]\nkind = "marine radar"\nplatform = { source = "gps" }\n'
                    'input = "udp://:60005"\n[sources.gps]\ninput = "udp://:60006"\n')  # fmt: skip
    settings = read_settings(path)
    assert settings.sources["gps"].description.kind == "tracks"
    taken = []
    replay = Replay([("arpa", at(START_S)), ("gps", at(START_S))])
    reception = Reception(settings, lambda: START_S, replay=replay, use=lambda name, reports: taken.append(name))
    reception.take(START_S)
    assert taken == ["gps", "arpa"]


def test_a_receiver_of_gnss_alone_carries_the_radar_of_another_wire_and_is_none(tmp_path):
    """RMC without AIS gave no reports live, so the radar had no place; in a file it had one."""
    path = tmp_path / "sensors.toml"
    inputs = '[sources.arpa]\nkind = "marine radar"\nplatform = { source = "gps" }\ninput = "udp://:60005"\n'
    inputs += '[sources.gps]\ninput = "udp://:60006"\n[sources.other]\nkind = "ais"\ninput = "udp://:60007"\n'
    path.write_text(inputs)
    taken, now_s = [], START_S + 1.0
    reception = Reception(read_settings(path), lambda: now_s, use=lambda name, reports: taken.append((name, reports)))
    sentences = [
        "$GPRMC,104000.00,A,5030.0000,N,00100.0000,W,10.0,090.0,010524,,,A*63\r\n",
        "$GPGGA,104001.00,5030.0000,N,00059.0000,W,1,08,1.0,20.0,M,47.0,M,,*47\r\n",
    ]
    for name in ("gps", "other"):
        wire = reception.wires[reception.settings.sources[name].url]
        for k, line in enumerate(sentences):
            body = line[1:].partition("*")[0]
            wire.play((START_S + k, f"${body}*{checksum(body):02X}\r\n".encode(), 0, True), 0)
    reception.take(now_s)
    assert [name for name, _ in taken] == ["gps"]
    places = taken[0][1]
    assert places.time_s.tolist() == [START_S, START_S + 1.0] and places.kind == OWN_POSITIONS
    assert places.lon_deg.tolist() == pytest.approx([-1.0, -59.0 / 60.0])


def test_a_source_without_a_wire_is_refused():
    with pytest.raises(InputError, match="west: has no input"):
        Reception(Settings({"west": LiveSource(Description("west", "tracks"))}), float, use=print)


def words_of(receiver, moments, stamp):
    """The texts of the alarms of a source's clock, at moments of which each has a report stamped ``stamp(moment)``."""
    texts = []
    for moment in moments:
        receiver.now_s = START_S + moment
        receiver.reception.taken_s = receiver.now_s
        receiver.reception.add("west", at(START_S + stamp(moment)), receiver.now_s)
        found = [alarm.text for alarm in receiver.reception.alarms() if alarm.key == "clock west"]
        texts += [text for text in found if text not in texts]
    return texts


def test_a_source_that_repeats_its_last_reports_is_frozen_and_not_late():
    texts = words_of(Receiver(), range(70), lambda t: min(t, 5.0))
    assert texts[0] == "west: repeats its last reports, whose time stamps are 31 s old: it is frozen, or its clock is"
    assert not any("receipt" in text for text in texts)


def test_a_source_that_sends_after_a_pause_what_it_kept_has_no_late_clock():
    # Silent for a minute; what it had kept comes in ten seconds, then all is as before.
    moments = [*range(10), *range(70, 100)]
    texts = words_of(Receiver(silent_s=600.0), moments, lambda t: t if t < 10 else min(10.0 + 7.0 * (t - 70.0), t))
    assert texts[0] == "west: sends, after a pause of 1.0 min, what it had kept; its last reports are 1.0 min old"
    assert len(texts) == 5 and all("what it had kept" in text for text in texts)


@pytest.mark.parametrize(("moments", "seconds"), [(range(70), -45.0), (range(70), 45.0), ([0, *range(70, 150)], -45.0)])
def test_a_clock_that_is_wrong_by_a_constant_time_is_called_so_also_after_a_pause(moments, seconds):
    texts = words_of(Receiver(silent_s=600.0), moments, lambda t: t + (seconds if t > 9 else 0.0))
    sense = "behind" if seconds < 0.0 else "ahead of"
    assert texts[-1] == f"west: its time stamps are 45 s {sense} the times of receipt"


def alarms_of(data, url="serial:/dev/ttyUSB0?baud=38400", fmt=None):
    """The texts of the alarms of an AIS source after these data and a silence."""
    pytest.importorskip("serial")
    now_s = [START_S]
    source = LiveSource(Description("coast", "ais"), url, fmt)
    reception = Reception(Settings({"coast": source}), lambda: now_s[0], use=lambda *_: None)
    wire = reception.wires[url]
    wire.state.connected = True
    for _ in range(3):
        now_s[0] += 30.0
        wire.receive(data)
        reception.take(now_s[0])
    return [alarm.text for alarm in reception.alarms()]


@pytest.mark.parametrize("fmt", [None, "nmea"])
@pytest.mark.parametrize("data", [b"\xf8\x80\xe6\x00" * 40, b"\xf8\x80\xe6\n" * 40])
def test_a_serial_line_of_another_speed_is_said(data, fmt):
    [text] = alarms_of(data, fmt=fmt)
    assert text.endswith("none of it can be read: is its speed another than ?baud=38400?")


def test_the_sentences_that_arrive_are_named_where_a_source_has_none_of_its_own():
    data = b"".join(f"${body}*{checksum(body):02X}\r\n".encode() for body in ("HEHDT,12.0,T", "SDDBT,1.0,f,,M,,F"))
    [text] = alarms_of(data)
    assert text.endswith("but none are its reports (sentences DBT, HDT)")


def block_048(moment_s):
    """A plot of category 048 in ASTERIX, of the radar 10/1, in the second of this moment."""
    second = int(moment_s % 86400.0) * 128
    record = bytes([0b11110000, 10, 1, *second.to_bytes(3, "big"), 0x20, 0x05, 0, 0x20, 0])
    return bytes([48]) + (len(record) + 3).to_bytes(2, "big") + record


@pytest.mark.parametrize(
    ("kinds", "taker", "words"),
    [
        (["marine radar"], "s0", ""),
        (["marine radar", "air radar"], "s1", ""),
        (["ais"], None, "(048 10/1 is there, of kind air radar, not ais: change kind in its table)"),
    ],
)
def test_the_kind_that_was_given_takes_the_asterix_of_a_coast_radar(kinds, taker, words, tmp_path):
    """A coast radar that speaks ASTERIX 048, described as marine radar, showed nothing, and nothing said why."""
    path, taken, now = tmp_path / "sensors.toml", [], [START_S]
    path.write_text("".join(f'[sources.s{k}]\nkind = "{kind}"\ninput = "{URL}"\n' for k, kind in enumerate(kinds)))
    reception = Reception(read_settings(path), lambda: now[0], use=lambda name, reports: taken.append(name))
    for _ in range(2):
        now[0] += 31.0
        reception.wires[URL].play((now[0], block_048(now[0]), 1, False), 0)
        reception.take(now[0])
    assert set(taken) == ({taker} if taker else set())
    assert [alarm.text for alarm in reception.alarms() if words and words in alarm.text] or not words
