"""The operator's page in headless Chromium (Debian's package, driven by Playwright), and malformed requests to its socket.

The program is target/release/echotank, or ECHOTANK.
"""

import json
import math
import os
import re
import shutil
import socket
import struct
import sys
import tempfile
import time
import unittest
import urllib.error
import urllib.request

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import sevenk_reader as reader  # noqa: E402
from page_client import Closed, PageClient, head_of  # noqa: E402
from test_daemon_readers import PATIENCE_S, ROOT, Daemon  # noqa: E402

BROWSER = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
SOUND_M_PER_S = 1500.0

# A ship that goes east at 3 m/s, 5 m below the surface, and one target abeam to starboard of where it is after 6 s.
SPEED_M_PER_S = 3.0
DEPTH_M = 5.0
ATTITUDE_DEG = (3.0, -2.0, 90.0)
BEGAN_S = 1793611200
TARGET_M = (-30.0, 18.0, 20.0)
TRANSMITTER_M = (0.8, 0.1, 0.7)
STARBOARD_M = (1.0, 0.5, 0.8)
SCRIPT = '<img src=x onerror="window.pwned=1"><script>window.pwned=1</script>'


def rig(folder, more=""):
    """hil-configs/points.toml with the ship and the target in it: the file, and settings."""
    track = os.path.join(folder, "track.csv")
    with open(track, "w", encoding="ascii") as file:
        file.write("time_s,north_m,east_m,down_m,roll_deg,pitch_deg,heading_deg\n")
        for quarter in range(-8, 2400):
            t = quarter / 4
            file.write(f"{BEGAN_S + t:.2f},0.00,{SPEED_M_PER_S * t:.4f},{DEPTH_M:.2f},%.1f,%.1f,%.1f\n" % ATTITUDE_DEG)
    points = os.path.join(folder, "points.csv")
    with open(points, "w", encoding="ascii") as file:
        file.write("north_m,east_m,down_m,amplitude\n300.0,0.0,5.0,1e-9\n")
    targets = os.path.join(folder, "targets.csv")
    with open(targets, "w", encoding="ascii") as file:
        file.write("name,north_m,east_m,height_above_seabed_m,target_strength_db\nbuoy,%g,%g,0,6\n" % TARGET_M[:2])
    with open(os.path.join(ROOT, "hil-configs", "points.toml"), encoding="utf-8") as file:
        text = file.read()
    text += '\n[scene.seabed]\nshape = "plane"\ndepth_m = %g\ndensity_per_m2 = 0.01\nlambert_db = -80.0\n' % TARGET_M[2] + more
    path = os.path.join(folder, "rig.toml")
    with open(path, "w", encoding="utf-8") as file:
        file.write(text)
    return path, [f'nav.source.0.path="{track}"', f'scene.points="{points}"', f'scene.targets="{targets}"', "nav.loop=true",
            "sonar.model.synthesis=direct", "sonar.ping.range_m=50", "sonar.ping.rate_hz=10", "sonar.limits.range_m=[10.0, 60.0]",
            "sonar.limits.gain_db=[0.0, 10.0]"]


def world_m(seconds, body_m):
    """World position of a body position: Rz(heading) Ry(pitch) Rx(roll), as in hil-configs/points.toml."""
    roll, pitch, heading = (math.radians(a) for a in ATTITUDE_DEG)
    x, y, z = body_m
    y, z = y * math.cos(roll) - z * math.sin(roll), y * math.sin(roll) + z * math.cos(roll)
    x, z = x * math.cos(pitch) + z * math.sin(pitch), -x * math.sin(pitch) + z * math.cos(pitch)
    x, y = x * math.cos(heading) - y * math.sin(heading), x * math.sin(heading) + y * math.cos(heading)
    return (x, y + SPEED_M_PER_S * seconds, z + DEPTH_M)


def two_way_s(seconds):
    """Delay of the target's echo at the starboard array, for a pulse at a time on the track."""
    out_m = math.dist(world_m(seconds, TRANSMITTER_M), TARGET_M)
    delay_s = 0.0
    for _ in range(20):
        delay_s = (out_m + math.dist(world_m(seconds + delay_s, STARBOARD_M), TARGET_M)) / SOUND_M_PER_S
    return delay_s


class Page(unittest.TestCase):
    """One daemon and one page for all tests; each restores their state."""

    @classmethod
    def setUpClass(cls):
        if not BROWSER:
            raise AssertionError("no chromium: apt-get install chromium, or name one in CHROMIUM")
        from playwright.sync_api import sync_playwright
        cls.folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(cls.folder.cleanup)
        cls.rig, cls.settings = rig(cls.folder.name)
        cls.start("127.0.0.1:0")
        cls.addClassCleanup(lambda: cls.daemon.stop())
        cls.playwright = sync_playwright().start()
        cls.addClassCleanup(cls.playwright.stop)
        # Chromium has no sandbox for root.
        cls.browser = cls.playwright.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"] if os.geteuid() == 0 else [])
        cls.addClassCleanup(cls.browser.close)
        cls.page = cls.browser.new_page(viewport={"width": 1280, "height": 800}, color_scheme="dark")
        cls.page.set_default_timeout(PATIENCE_S * 1000)
        cls.said = []
        cls.page.on("console", lambda message: cls.said.append((message.type, message.text)))
        cls.page.on("pageerror", lambda error: cls.said.append(("error", str(error))))
        cls.page.goto(f"http://{cls.at}/")

    @classmethod
    def start(cls, listen):
        cls.daemon = Daemon(cls.rig, "sonar.output.sevenk.listen=127.0.0.1:0", f"control.listen={listen}", *cls.settings)
        cls.sevenk = cls.daemon.address(r"7k points tcp")
        host, port = cls.daemon.address(r"control http")
        cls.at = f"{host}:{port}"

    def setUp(self):
        self.wait("() => Number(document.getElementById('ping').textContent) > 0")

    def tearDown(self):
        # Reading canvases back causes a warning that is not the page's fault.
        complaints = [said for said in self.said if said[0] in ("error", "warning") and "getImageData" not in said[1]]
        self.assertEqual(complaints, [], "the page complained")

    def wait(self, condition, argument=None):
        self.page.wait_for_function(condition, arg=argument)

    def wait_text(self, place, text):
        self.wait("([place, text]) => document.querySelector(place).textContent.includes(text)", [place, text])

    def status(self):
        with urllib.request.urlopen(f"http://{self.at}/status", timeout=10) as reply:
            return json.load(reply)

    def test_a_known_target_is_drawn_where_its_range_and_time_say(self):
        page = self.page
        # Abeam after 6 s; slightly later the target is in the image, and time is paused.
        self.wait("() => { const t = document.getElementById('clock').textContent.slice(-8); return t >= '09:20:10' && t < '09:29:00'; }")
        page.evaluate("document.activeElement.blur()")
        page.keyboard.press("Space")
        self.wait_text("#state", "paused")
        page.wait_for_timeout(300)
        box = page.locator("#wf").bounding_box()
        width = page.evaluate("document.getElementById('wf').width")
        scale = width / box["width"]
        best = []
        for row in range(2, int(box["height"] * scale / 2) - 2):
            # The cursor shows number and time of a row's ping.
            page.mouse.move(box["x"] + box["width"] / 2 + 40, box["y"] + (2 * row + 1) / scale)
            page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
            text = page.locator("#wf-cursor").text_content()
            when = re.search(r"ping (\d+) +09:(\d\d):(\d\d\.\d+)", text)
            if not when:
                break
            seconds = 60 * int(when.group(2)) + float(when.group(3)) - 1200
            if seconds < 5.0:
                break
            if abs(seconds - 5.8) > 0.6:
                # Ten pings per second, the newest on top.
                continue
            pixels = page.evaluate("""(y) => {
                const canvas = document.getElementById("wf");
                const row = canvas.getContext("2d").getImageData(0, y, canvas.width, 1).data;
                return Array.from({ length: canvas.width }, (_, x) => row[4 * x] + row[4 * x + 1] + row[4 * x + 2]);
            }""", 2 * row)
            half = width // 2
            want = width / 2 + two_way_s(seconds) * SOUND_M_PER_S / 2 / 50.0 * half
            starboard = pixels[half + 10:]
            loudest = max(starboard)
            got = [half + 10 + k for k, value in enumerate(starboard) if value == loudest]
            best.append((seconds, want, got[0], got[-1]))
        self.assertGreaterEqual(len(best), 8, "rows about the target")
        for seconds, want, first, last in best:
            # A pixel is 0.1 m, a sample 0.02 m; the brightest colour may cover one neighbour.
            self.assertTrue(first - 1.0 <= want <= last + 1.5 and last - first <= 3, f"at {seconds} s: drawn at {first} to {last}, predicted {want:.1f}")
        # The truth mark is also shown, at the ping broadside to the target, in its own colour.
        marked = page.evaluate("""() => {
            const canvas = document.getElementById("wf-over");
            const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
            const found = [];
            for (let k = 0; k < data.length; k += 4) if (data[k] > 240 && data[k + 1] < 120 && data[k + 2] > 180 && data[k + 3] > 200) found.push([(k / 4) % canvas.width, Math.floor(k / 4 / canvas.width)]);
            return found;
        }""")
        self.assertTrue(marked, "no mark of the truth")
        nearest = min(abs(x - best[len(best) // 2][1]) for x, _ in marked)
        self.assertLess(nearest, 9, "the mark of the truth lies beside the echo")
        page.keyboard.press("Space")
        self.wait_text("#state", "pinging")

    def test_a_range_set_on_the_page_reaches_a_7k_client_and_back(self):
        page = self.page
        findings = reader.Findings()
        session = reader.Session(self.sevenk, findings, gapless=False)
        self.addCleanup(session.close)
        session.command(reader.SUBSCRIBE, struct.pack("<II", 1, 7000))

        def ranges():
            return [ping.settings["range_selection"] for ping in session.pings if ping.settings]
        self.assertTrue(session.pump(PATIENCE_S, lambda: len(ranges()) > 1))
        page.fill("#set-range_m", "40")
        page.press("#set-range_m", "Enter")
        self.assertTrue(session.pump(PATIENCE_S, lambda: ranges()[-1] == 40.0), ranges()[-5:])
        self.wait_text("#now-range_m", "40 m")
        self.wait_text("#note-range_m", "requested 40 by page 127.0.0.1:")
        session.command(reader.RANGE, struct.pack("<f", 45.0))
        self.wait_text("#now-range_m", "45 m")
        port = session.socket.getsockname()[1]
        self.wait_text("#note-range_m", f"requested 45 by 7k 127.0.0.1:{port}")
        # A refused command gives a reason and has no effect.
        page.fill("#set-range_m", "1000")
        page.press("#set-range_m", "Enter")
        self.wait_text("#note-range_m", "range_m = 1000: must be from 10 to 60")
        self.wait_text("#log", "must be from 10 to 60")
        self.assertIn("45 m", page.locator("#now-range_m").text_content())
        page.fill("#set-range_m", "50")
        page.press("#set-range_m", "Enter")
        self.wait_text("#now-range_m", "50 m")

    def test_a_fault_shows_at_its_element_and_in_its_time(self):
        page = self.page
        page.select_option("#fault-kind", "dead")
        page.select_option("#fault-form [name=array]", "0")
        page.fill("#fault-form [name=element]", "2")
        page.fill("#fault-form [name=for_s]", "600")
        page.click("#fault-form button")
        self.wait_text("#faults", "dead at port 2")
        self.wait_text("#faults", "s left")
        page.click("#tab-elements")
        self.wait_text("#elements-cursor", "1 with a fault: dead")
        box = page.locator("#elements").bounding_box()
        # The third of eight bars of the first of three arrays; the axis takes 40 pixels.
        page.mouse.move(box["x"] + 40 + (box["width"] - 48) * 2.4 / 8, box["y"] + box["height"] / 6)
        self.wait_text("#elements-cursor", "port 2   rms -600.0 dB")
        page.click("#faults button")
        self.wait("() => document.getElementById('faults').children.length === 0")
        page.mouse.move(0, 0)
        self.wait_text("#log", "clear-faults")
        page.click("#tab-fan")

    def test_every_view_draws_and_time_goes_by_steps(self):
        page = self.page
        page.evaluate("document.activeElement.blur()")
        for key, place in (("2", "scope"), ("3", "elements"), ("4", "track"), ("5", "motion"), ("1", "fan")):
            page.keyboard.press(key)
            self.wait("""(id) => {
                const canvas = document.getElementById(id);
                if (canvas.offsetParent === null) return false;
                const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
                return new Set(new Uint32Array(data.buffer)).size > 8;
            }""", place)
        for show in ("iq", "spectrum", "envelope"):
            page.keyboard.press("2")
            page.select_option("#scope-show", show)
            page.evaluate("document.activeElement.blur()")
        page.keyboard.press("6")
        self.wait_text("#health", "Margin: computed before due")
        page.keyboard.press("4")
        page.keyboard.press("1")
        page.click("#pause")
        self.wait_text("#state", "paused")
        before = self.status()["pings_delivered"]
        page.click("#step")
        deadline = time.monotonic() + PATIENCE_S
        while self.status()["pings_delivered"] != before + 1:
            self.assertLess(time.monotonic(), deadline)
            time.sleep(0.05)
        page.click("#pause")
        self.wait_text("#state", "pinging")

    def test_words_from_outside_are_words(self):
        page = self.page
        for command in ({"do": "fault", "kind": SCRIPT}, {"do": "set", "sonar": SCRIPT, "range_m": 20.0}):
            request = urllib.request.Request(f"http://{self.at}/control", json.dumps(command).encode(), {"Content-Type": "application/json"})
            with self.assertRaises(urllib.error.HTTPError) as refused:
                urllib.request.urlopen(request, timeout=10)
            self.assertEqual(refused.exception.code, 409)
            refused.exception.close()
            self.wait_text("#log", SCRIPT)
        client = PageClient(self.at)
        self.addCleanup(client.close)
        client.send({"command": {"id": 1, "command": {"do": "fault", "kind": SCRIPT}}})
        page.wait_for_timeout(300)
        self.assertEqual(page.evaluate("[window.pwned ?? null, document.querySelectorAll('#log img, #log script').length]"), [None, 0])

    def test_a_token_is_asked_for_and_opens_the_page(self):
        daemon = Daemon(self.rig, "sonar.output.sevenk.listen=127.0.0.1:0", "control.listen=127.0.0.1:0", "control.token=open-sesame", *self.settings)
        self.addCleanup(daemon.stop)
        at = "%s:%d" % daemon.address(r"control http")
        for protocols, origin, want in ((["echotank"], None, 401), (["echotank", "token." + b"open".hex()], None, 401),
                                        (["echotank", "token." + b"open-sesame".hex()], "http://evil.example", 403),
                                        (["echotank", "token." + b"open-sesame".hex()], f"http://{at}", 101)):
            client = PageClient(at, origin=origin, protocols=protocols)
            self.addCleanup(client.close)
            self.assertEqual(client.status, want, (protocols, origin))
        page = self.browser.new_page()
        self.addCleanup(page.close)
        page.set_default_timeout(PATIENCE_S * 1000)
        page.goto(f"http://{at}/")
        page.fill("#token", "open-sesame")
        page.click("#token-form button")
        page.wait_for_function("() => Number(document.getElementById('ping').textContent) > 0")

    def test_z_the_page_comes_back_when_the_daemon_does(self):
        listen = self.at
        self.daemon.stop()
        self.wait_text("#state", "no connection")
        # The browser itself reports that the server is gone.
        type(self).start(listen)
        self.wait_text("#state", "pinging")
        self.wait("() => { const n = Number(document.getElementById('ping').textContent); return n > 0 && n < 200; }")
        self.assertTrue(self.page.locator("#banner").is_hidden())
        self.said[:] = [said for said in self.said if "ERR_CONNECTION_REFUSED" not in said[1] and "WebSocket" not in said[1]]


class Hostile(unittest.TestCase):
    """Malformed and hostile requests."""

    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.nav = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.addCleanup(self.nav.close)
        path, settings = rig(folder.name, '\n[[nav.source]]\nname = "gate"\nkind = "udp"\nlisten = "127.0.0.1:0"\nprovides = ["heave"]\n')
        self.daemon = Daemon(path, "sonar.output.sevenk.listen=127.0.0.1:0", "control.listen=127.0.0.1:0", *settings)
        self.addCleanup(self.daemon.stop)
        self.gate = self.daemon.address(r"nav gate udp")
        self.sevenk = self.daemon.address(r"7k points tcp")
        self.at = "%s:%d" % self.daemon.address(r"control http")

    def status(self):
        with urllib.request.urlopen(f"http://{self.at}/status", timeout=10) as reply:
            return json.load(reply)

    def open(self, **how):
        client = PageClient(self.at, **how)
        self.addCleanup(client.close)
        return client

    def until(self, client, wanted):
        """Reads until the wanted message."""
        deadline = time.monotonic() + PATIENCE_S
        while not wanted(client.receive()):
            self.assertLess(time.monotonic(), deadline, "it never came")

    def ended(self, client):
        """Reads until the daemon closes."""
        try:
            while True:
                client.receive()
        except Closed:
            return True

    def test_strangers_long_frames_and_crowds_cost_no_ping(self):
        session = reader.Session(self.sevenk, reader.Findings(), gapless=False)
        self.addCleanup(session.close)
        session.command(reader.SUBSCRIBE, struct.pack("<II", 1, 7000))
        self.assertTrue(session.pump(PATIENCE_S, lambda: len(session.pings) > 2))
        first = len(session.pings)

        # Other origins; foreign host names that resolve to this host.
        for origin in ("http://evil.example", "null", "http://127.0.0.1:1", "file://"):
            self.assertEqual(self.open(origin=origin).status, 403, origin)
        self.assertEqual(self.open(origin=f"http://{self.at}").status, 101)
        for path, headers, want in (("/page/socket", {}, 400), ("/", {"Host": "evil.example"}, 200), ("/status", {"Host": "evil.example"}, 403),
                                    ("/page/nothing.js", {}, 404), ("/page/../../Cargo.toml", {}, 404)):
            request = urllib.request.Request(f"http://{self.at}{path}", headers=headers)
            try:
                with urllib.request.urlopen(request, timeout=10) as reply:
                    got = reply.status
                    policy = reply.headers.get("Content-Security-Policy", "")
                    self.assertIn("default-src 'none'", policy)
                    self.assertNotIn("unsafe", policy)
            except urllib.error.HTTPError as error:
                got = error.code
                error.close()
            self.assertEqual(got, want, path)

        # Malformed: answered with an error, and still served.
        client = self.open()
        for text in ("", "{", "[]", '{"look": {"sonar": 99999999}}', '{"look": {"sonar": 0, "scope": {"of": "nothing"}}}', '{"command": {"id": -1}}',
                     '{"relief": {"level": 300, "row": 0, "col": 0}}', '{"command": {"id": 1, "command": {"do": "explode"}}}', "[" * 10_000):
            client.send(text)
            self.until(client, lambda reply: isinstance(reply, dict) and "error" in reply)
        client.send({"look": {"sonar": 65535}})
        client.send({"relief": {"level": 0, "row": 2**31 - 1, "col": -2**31}})
        client.send({"look": {"sonar": 0, "fan": True, "elements": True, "scope": {"of": "element", "array": 65535, "index": 65535, "first": 2**32 - 1}}})
        kinds = set()

        def all_kinds(reply):
            if isinstance(reply, bytes):
                kinds.add(head_of(reply)[0])
            return kinds >= {1, 2, 3, 4}
        self.until(client, all_kinds)
        # Oversized, unmasked, reserved: closed.
        for spoil in (lambda c: c.send("x" * 20_000), lambda c: c.send_frame(1, b"{}", masked=False), lambda c: c.socket.sendall(b"\xff" * 64),
                      lambda c: c.socket.sendall(struct.pack(">BBQ", 0x82, 0xFF, 2**62) + b"1234")):
            spoiled = self.open()
            spoil(spoiled)
            self.assertTrue(self.ended(spoiled))

        # Fifty clients that subscribe to everything and do not read; and a page of text.
        crowd = [self.open(receive_bytes=4096) for _ in range(50)]
        for index, client in enumerate(crowd):
            client.send({"look": {"sonar": 0, "fan": True, "elements": True, "scope": {"of": "element", "array": 0, "index": index % 8, "first": 0}}})
            for tile in range(4):
                client.send({"relief": {"level": 0, "row": tile, "col": index}})
        for k in range(200):
            self.nav.sendto(f"$GPGGA,{SCRIPT},{k}\r\n$PASHR,{SCRIPT}*00\r\n".encode() + bytes([k]) * 40, self.gate)
        self.assertTrue(session.pump(PATIENCE_S, lambda: len(session.pings) >= first + 60))
        numbers = [ping.number for ping in session.pings]
        self.assertEqual(numbers, list(range(numbers[0], numbers[0] + len(numbers))), "a ping is missing")
        status = self.status()
        counters = status["sonars"][0]["counters"]
        self.assertEqual([counters[key] for key in ("pings_skipped_late", "pings_skipped_queue", "pings_skipped_nav")], [0, 0, 0])
        self.assertGreaterEqual(status["page"]["pages"], 50)
        # The remaining connections are accepted, further ones refused.
        more = [self.open() for _ in range(20)]
        self.assertIn(503, [client.status for client in more])
        self.assertNotIn(SCRIPT, json.dumps(status["nav"]), "sentence fields are not in the status")


if __name__ == "__main__":
    unittest.main()
