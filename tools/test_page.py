"""The operator's page in headless Chromium (Debian's package, driven by Playwright), and malformed requests to its socket.

The program is target/release/echotank, or ECHOTANK.
"""

import csv
import io
import json
import math
import os
import re
import shutil
import socket
import statistics
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


class Browser(unittest.TestCase):
    """One daemon and one page for all tests of a class; each restores their state."""

    @classmethod
    def setUpClass(cls):
        if not BROWSER:
            raise AssertionError("no chromium: apt-get install chromium, or name one in CHROMIUM")
        from playwright.sync_api import sync_playwright
        cls.folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(cls.folder.cleanup)
        cls.rig, cls.settings = cls.configure()
        cls.start("127.0.0.1:0")
        cls.addClassCleanup(lambda: cls.daemon.stop())
        cls.playwright = sync_playwright().start()
        cls.addClassCleanup(cls.playwright.stop)
        # Chromium has no sandbox for root.
        cls.browser = cls.playwright.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"] if os.geteuid() == 0 else [])
        cls.addClassCleanup(cls.browser.close)
        cls.said = []
        cls.page = cls.open()

    @classmethod
    def open(cls, at=None):
        page = cls.browser.new_page(viewport={"width": 1280, "height": 800}, color_scheme="dark")
        page.set_default_timeout(PATIENCE_S * 1000)
        page.on("console", lambda message: cls.said.append((message.type, message.text)))
        page.on("pageerror", lambda error: cls.said.append(("error", str(error))))
        page.goto(f"http://{at or cls.at}/")
        return page

    @classmethod
    def start(cls, listen):
        cls.daemon = Daemon(cls.rig, "sonar.output.sevenk.listen=127.0.0.1:0", f"control.listen={listen}", *cls.settings)
        cls.sevenk = cls.daemon.address(r"7k \w+ tcp")
        host, port = cls.daemon.address(r"control http")
        cls.at = f"{host}:{port}"

    def setUp(self):
        self.wait("() => Number(document.getElementById('ping').textContent) > 0")

    def tearDown(self):
        # Reading canvases back causes a warning that is not the page's fault.
        complaints = [said for said in self.said if said[0] in ("error", "warning") and "getImageData" not in said[1]]
        self.assertEqual(complaints, [], "the page complained")

    def wait(self, condition, argument=None):
        from playwright.sync_api import TimeoutError
        try:
            self.page.wait_for_function(condition, arg=argument)
        except TimeoutError:
            shown = self.page.evaluate("() => ['state', 'reason', 'log'].map((id) => document.getElementById(id).textContent.slice(0, 400))")
            raise AssertionError(f"{condition} with {argument} did not come; the page shows {shown}") from None

    def wait_state(self, text):
        self.wait("(text) => document.getElementById('state').textContent === text", text)

    def wait_text(self, place, text):
        self.wait("([place, text]) => document.querySelector(place).textContent.includes(text)", [place, text])

    def status(self):
        with urllib.request.urlopen(f"http://{self.at}/status", timeout=10) as reply:
            return json.load(reply)


class Page(Browser):
    """A known target, commands from several sides, and the way back after a restart."""

    @classmethod
    def configure(cls):
        return rig(cls.folder.name)

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
        order = page.evaluate("""() => ["ul.checks", "table", ".bins"].map((part) => document.querySelector("#health " + part).getBoundingClientRect().top)""")
        self.assertEqual(order, sorted(order), "the verdict comes before the ports, these before the histograms")
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


DRIVEN = """() => {
    // Every control that was used, by its name. Playwright selects without a trusted event.
    window.driven = new Set();
    window.nameOf = (control) => control.id || control.name || [control.closest("[data-save-of]")?.dataset.saveOf, control.dataset.save ?? control.textContent].join(" ");
    for (const kind of ["click", "input"]) document.addEventListener(kind, (e) => {
        const control = e.target.closest("button, input, select");
        const isPressed = control?.matches("button, [type=checkbox]");
        if ((e.isTrusted || control?.matches("select")) && control && isPressed === (kind === "click")) window.driven.add(window.nameOf(control));
    }, true);
}"""


class Profiles(Browser):
    """A rig with a sound-speed profile."""

    @classmethod
    def configure(cls):
        path, settings = rig(cls.folder.name, "\n[medium.profile]\npoints = [[0.0, 1500.0], [20.0, 1490.0]]\n")
        with open(path, encoding="utf-8") as file:
            lines = [line for line in file if not line.startswith("sound_speed_m_per_s")]
        with open(path, "w", encoding="utf-8") as file:
            file.writelines(lines)
        return path, settings

    def set(self, text):
        self.page.fill("#profile-points", text)
        self.page.click("#profile-set")

    def test_a_profile_is_shown_set_refused_and_read_from_a_file(self):
        page = self.page
        page.click("#profile summary")
        self.assertEqual(page.input_value("#profile-points"), "0 1500\n20 1490")
        self.assertEqual(page.text_content("#profile-now"), "2 points, 1490 to 1500 m/s")
        self.set("0 1510\n4; 1509\n9, 1478")
        self.wait_text("#profile-note", "set")
        self.wait_text("#profile-now", "3 points, 1478 to 1510 m/s")
        self.wait_text("#log", "profile of 3 points accepted")
        for text, why in (("5 1500", "must be 2 to 1000"), ("0 1500\n9 1480\n4 1490", "depth"), ("0 1500\n9 150", "1300"), ("0 1500\n9 fast", "line 2: expected a depth")):
            self.set(text)
            self.wait_text("#profile-note", why)
            self.assertEqual(page.get_attribute("#profile-note", "data-is"), "bad")
        self.assertEqual(page.text_content("#profile-now"), "3 points, 1478 to 1510 m/s", "what was refused is not shown")
        for name, content, points in (("cast.txt", "depth speed\n0,1499\n8,1481.5\n", 2), ("cast.asvp", "( SoundVelocity 1.0 0 202611261200 )\n0.0 1499.0\n3.0 1495.0\n8.0 1481.5\n", 3)):
            page.set_input_files("#profile-file", {"name": name, "mimeType": "text/plain", "buffer": content.encode()})
            self.wait_text("#profile-note", f"{name}: {points} points, not set yet")
            page.click("#profile-set")
            self.wait_text("#profile-now", f"{points} points, 1481.5 to 1499 m/s")
        # A page that opens later shows the profile in force, and one without profile has no such control.
        later = self.open()
        self.addCleanup(later.close)
        later.wait_for_function("() => document.getElementById('profile-points').value === '0 1499\\n3 1495\\n8 1481.5'")


class Ranges(Browser):
    """The rig of the quickstart, some 52 m above the seabed, at 50 m, 100 m and 150 m, with recordings and bottom detection."""

    RANGES_M = (50, 100, 150)

    @classmethod
    def configure(cls):
        cls.records = os.path.join(cls.folder.name, "records")
        with open(os.path.join(ROOT, "hil-configs", "quickstart.toml"), encoding="utf-8") as file:
            text = file.read().replace('path = "data/', f'path = "{ROOT}/hil-configs/data/').replace('targets = "data/', f'targets = "{ROOT}/hil-configs/data/')
        path = os.path.join(cls.folder.name, "rig.toml")
        with open(path, "w", encoding="utf-8") as file:
            file.write(text + f'\n[record]\ndirectory = "{cls.records}"\nat_start = false\n')
        return path, ["sonar.ping.range_m=50", "sonar.limits.range_m=[20.0, 200.0]", "sonar.beams.fan.bottom_detection=true"]

    def setUp(self):
        super().setUp()
        self.page.mouse.move(0, 0)

    def set_range(self, range_m):
        self.page.fill("#set-range_m", str(range_m))
        self.page.press("#set-range_m", "Enter")
        self.wait_text("#now-range_m", f"{range_m} m")

    def rows(self, pings):
        """Waits until so many pings of the present range have come."""
        last = int(self.page.text_content("#ping"))
        self.wait("(last) => Number(document.getElementById('ping').textContent) > last", last + pings)

    def download(self, place):
        with self.page.expect_download() as download:
            self.page.click(place)
        path = download.value.path()
        with open(path, "rb") as file:
            return download.value.suggested_filename, file.read()

    def csv(self, place):
        name, content = self.download(place)
        lines = content.decode().splitlines()
        about = [line for line in lines if line.startswith("#")]
        return name, about, list(csv.DictReader(io.StringIO("\n".join(lines[len(about):])), restkey="more"))

    def picture(self, place):
        """Name, width and height of a saved picture."""
        name, content = self.download(place)
        self.assertEqual(content[:8], b"\x89PNG\r\n\x1a\n", name)
        return (name, *struct.unpack_from(">II", content, 16))

    def press_outside(self, key):
        self.page.evaluate("document.activeElement.blur()")
        self.page.keyboard.press(key)

    def brightness(self, pings=20):
        """Of the newest pings, from 0 (darkest colour) to 1 (brightest): mean and spread where the seabed lies, and mean in the water column."""
        low, high = (float(self.page.input_value(f"#wf-{end}")) for end in ("low", "high"))
        _, _, rows = self.csv("#wf-data")
        seabed, water = [], []
        for row in rows[:2 * pings]:
            altitude, first, step = (float(row[key]) for key in ("altitude_m", "first_m", "step_m"))
            for k, level in enumerate([row["levels"], *row["more"]]):
                slant = first + k * step
                shade = min(1.0, max(0.0, (float(level) - low) / (high - low))) if level else 0.0
                if slant > 1.1 * altitude:
                    seabed.append(shade)
                elif 3.0 < slant < 0.85 * altitude:
                    water.append(shade)
        seen = {"water": statistics.fmean(water), "seabed": len(seabed)}
        return {**seen, "mean": statistics.fmean(seabed), "spread": statistics.pstdev(seabed)} if seabed else seen

    def test_the_seabed_alone_sets_the_contrast_at_every_range(self):
        for range_m in self.RANGES_M:
            self.set_range(range_m)
            self.rows(40)
            seen = self.brightness()
            with self.subTest(range_m=range_m, **seen):
                self.assertLess(seen["water"], 0.04, "the water column is dark")
                if range_m > 60:
                    self.assertGreater(seen["seabed"], 1000)
                    self.assertTrue(0.25 < seen["mean"] < 0.65, "the seabed is neither black nor washed out")
                    self.assertGreater(seen["spread"], 0.15)
        low, high = (float(self.page.input_value(f"#wf-{end}")) for end in ("low", "high"))
        # A range that ends in the water column changes nothing.
        self.set_range(30)
        self.rows(30)
        now = [float(self.page.input_value(f"#wf-{end}")) for end in ("low", "high")]
        self.assertTrue(abs(now[0] - low) <= 3 and abs(now[1] - high) <= 3, (now, low, high))

    def test_a_page_that_opens_is_filled_from_recent_history(self):
        self.rows(30)
        page = self.open()
        self.addCleanup(page.close)
        page.wait_for_function("() => Number(document.getElementById('ping').textContent) > 0")
        filled = page.evaluate("""async () => {
            await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
            const canvas = document.getElementById("wf");
            const data = new Uint32Array(canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data.buffer);
            let rows = 0;
            for (let y = 0; y < canvas.height; y += 2) rows += data[y * canvas.width] !== 0;
            return rows;
        }""")
        self.assertGreaterEqual(filled, 30, "rows of a page that has just opened")

    def test_every_control_works_at_every_range(self):
        page = self.page
        page.evaluate(DRIVEN)
        for range_m in self.RANGES_M:
            with self.subTest(range_m=range_m):
                page.evaluate("() => window.driven.clear()")
                self.set_range(range_m)
                # Those in flight, 13 while the log settles, still have the range before.
                self.rows(20)
                self.drive_settings()
                self.drive_time()
                self.drive_waterfall(range_m)
                self.drive_samples()
                self.drive_platform(range_m)
                self.drive_faults()
                self.drive_recording()
                for button in ("#theme", "#theme", "#help"):
                    page.click(button)
                page.click("#about button")
                all_controls = page.evaluate("""() => [...document.querySelectorAll("button, input, select")]
                    .filter((c) => !c.closest("#ask-token, #log, #faults, #profile[hidden]")).map(window.nameOf)""")
                missed = set(all_controls) - set(page.evaluate("() => [...window.driven]"))
                # With one sonar there is no other to choose.
                self.assertEqual(missed, {"sonar"}, "controls that no event reached")

    def drive_settings(self):
        page = self.page
        for key, value, shown in (("source_level_db", "205", "205 dB"), ("gain_db", "3", "3 dB"), ("pulse_ms", "2", "2 ms"), ("rate_hz", "3", "3 /s"),
                                  ("source_level_db", "210", "210 dB"), ("gain_db", "0", "0 dB"), ("pulse_ms", "3", "3 ms"), ("rate_hz", "4", "4 /s")):
            page.fill(f"#set-{key}", value)
            page.click(f"#set-{key} + button")
            self.wait_text(f"#now-{key}", shown)
        page.fill("#set-range_m", page.text_content("#now-range_m").split()[0])
        page.click("#set-range_m + button")
        page.click("#start")
        self.wait_text("#state", "not pinging")
        self.assertNotEqual(page.get_attribute("#verdict", "data-is"), "good")
        before = self.status()["pings_delivered"]
        page.click("#single")
        self.wait_delivered(before + 1)
        # A sonar counts as pinging until its single ping is over, and the page hears of that twice a second.
        self.until(lambda: not self.status()["sonars"][0]["settings"]["pinging"])
        page.wait_for_timeout(700)
        page.click("#start")
        self.wait_state("pinging")
        for trigger, state in (("external", "waiting for triggers"), ("internal", "pinging")):
            page.select_option("#trigger", trigger)
            self.wait_state(state)

    def until(self, is_so):
        deadline = time.monotonic() + PATIENCE_S
        while not is_so():
            self.assertLess(time.monotonic(), deadline)
            time.sleep(0.05)

    def wait_delivered(self, pings):
        self.until(lambda: self.status()["pings_delivered"] >= pings)

    def drive_time(self):
        page = self.page
        page.select_option("#clock-mode", "scaled")
        self.wait_text("#state", "pinging ×2")
        page.fill("#clock-rate", "1.5")
        page.press("#clock-rate", "Enter")
        self.wait_text("#state", "pinging ×1.5")
        page.select_option("#clock-mode", "realtime")
        self.wait_state("pinging")
        page.click("#pause")
        self.wait_text("#state", "paused")
        before = self.status()["pings_delivered"]
        page.click("#step")
        self.wait_delivered(before + 1)
        page.click("#pause")
        self.wait_text("#state", "pinging")

    def drive_waterfall(self, range_m):
        page = self.page

        def drawn():
            return page.evaluate("""() => {
                const canvas = document.getElementById("wf");
                const data = new Uint32Array(canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data.buffer);
                return data.reduce((sum, v) => (sum * 31 + v) >>> 0, 0);
            }""")

        def changes(act):
            # Nothing else moves while time stands still.
            before = drawn()
            act()
            page.wait_for_function("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))")
            self.assertNotEqual(drawn(), before)
        page.click("#pause")
        self.wait_text("#state", "paused")
        page.wait_for_timeout(300)
        for name in ("grey", "viridis", "copper"):
            changes(lambda: page.select_option("#wf-map", name))
        for rows in ("1", "4", "2"):
            changes(lambda: page.select_option("#wf-rows", rows))
        for end, value in (("low", "-200"), ("high", "-100")):
            def fill():
                page.fill(f"#wf-{end}", value)
                page.press(f"#wf-{end}", "Enter")
            changes(fill)
        self.assertFalse(page.is_checked("#wf-auto"))
        changes(lambda: page.check("#wf-auto"))
        for _ in range(2):
            page.click("#wf-truth")
        changes(lambda: (page.focus("#wf"), page.keyboard.press("PageDown")))
        changes(lambda: page.click("#wf-live"))
        name, width, height = self.picture("#wf-picture")
        self.assertRegex(name, r"^echotank-hull-waterfall-\d{8}T\d{6}\.png$")
        self.assertTrue(width > 800 and height > 250, (width, height))
        name, about, rows = self.csv("#wf-data")
        self.assertIn("dB re 1 V", about[1])
        self.assertEqual({row["side"] for row in rows}, {"port", "starboard"})
        row = rows[0]
        levels = [row["levels"], *row["more"]]
        self.assertAlmostEqual(float(row["first_m"]) + len(levels) * float(row["step_m"]), range_m, delta=0.06 * range_m)
        self.assertEqual(row["ping"], page.text_content("#ping"))
        page.click("#pause")
        self.wait_text("#state", "pinging")

    def save_both(self, list_id, tab, columns):
        """Picture and data of a view, with the columns of the data."""
        page = self.page
        self.wait("([list, how]) => !document.querySelector(`[data-save-of=${list}] [data-save=${how}]`).disabled", [list_id, "data"])
        name, width, _ = self.picture(f"[data-save-of={list_id}] [data-save=picture]")
        self.assertIn(f"-{tab}-", name)
        self.assertGreater(width, 300)
        name, _, rows = self.csv(f"[data-save-of={list_id}] [data-save=data]")
        self.assertIn(f"-{tab}-", name)
        self.assertEqual([c for c in rows[0] if c != "more"], columns)
        self.assertEqual(page.evaluate("document.querySelectorAll('a[download]').length"), 0)
        return rows

    def drive_samples(self):
        page = self.page
        page.click("#tab-elements")
        self.wait_text("#elements-cursor", "no element faults")
        rows = self.save_both("tabs-samples", "elements", ["array", "element", "rms_db_re_1_v", "peak_db_re_1_v", "fault"])
        self.assertEqual(len(rows), 48)
        page.click("#tab-scope")
        for of, array, index in (("beam", "0", "3"), ("line", "1", None), ("element", "2", "5")):
            page.select_option("#scope-of", of)
            page.select_option("#scope-array", array)
            if index:
                page.fill("#scope-index", index)
                page.press("#scope-index", "Enter")
            for show in ("iq", "spectrum", "envelope"):
                page.select_option("#scope-show", show)
            self.wait("() => document.getElementById('scope-cursor').textContent.includes('samples at')")
        self.wait("() => !document.querySelector('[data-save-of=tabs-samples] [data-save=data]').disabled")
        self.save_both("tabs-samples", "a-scope", ["time_s", "i_v", "q_v"])
        page.click("#tab-fan")
        self.wait_text("#fan-cursor", "48 beams")
        rows = self.save_both("tabs-samples", "fan", ["angle_deg", "levels"])
        self.assertEqual(len(rows), 48)

    def drive_platform(self, range_m):
        page = self.page
        page.click("#tab-motion")
        self.wait_text("#nav-sources", "seapath")
        name, _, _ = self.picture("[data-save-of=tabs-platform] [data-save=picture]")
        self.assertIn("-navigation-", name)
        page.click("#tab-health")
        self.wait_text("#health", "Ports")
        self.assertTrue(page.is_disabled("[data-save-of=tabs-platform] [data-save=picture]"))
        page.click("#tab-track")
        for button in ("#track-in", "#track-out"):
            page.click(button)
        track = self.save_both("tabs-platform", "track", ["ping", "utc", "latitude_deg", "longitude_deg", "north_m", "east_m", "down_m", "heading_deg", "pitch_deg", "roll_deg",
                                                          "heave_m", "speed_m_per_s"])
        page.click("#tab-bathymetry")
        if range_m < 60:
            return
        self.wait_text("#bathymetry-cursor", "soundings")
        rows = self.save_both("tabs-platform", "bathymetry", ["ping", "latitude_deg", "longitude_deg", "north_m", "east_m", "depth_m"])
        depths = sorted(float(row["depth_m"]) for row in rows)
        below = float(re.search(r"bottom ([\d.]+) m below", page.text_content("#track-cursor")).group(1))
        bottom = below + float(track[-1]["down_m"])
        self.assertAlmostEqual(depths[len(depths) // 2], bottom, delta=3.0)
        east = [float(row["east_m"]) for row in rows]
        self.assertGreater(max(east) - min(east), 40.0, "a swath, not a line")
        colours = page.evaluate("""() => {
            const canvas = document.getElementById("bathymetry");
            return new Set(new Uint32Array(canvas.getContext("2d").getImageData(0, 0, canvas.width - 60, canvas.height).data.buffer)).size;
        }""")
        self.assertGreater(colours, 30, "depths have colours")

    def inject(self, kind, fields):
        page = self.page
        page.select_option("#fault-kind", kind)
        for name, value in fields.items():
            field = f"#fault-form [name={name}]"
            if page.evaluate("(f) => document.querySelector(f).tagName", field) == "SELECT":
                page.select_option(field, value)
            else:
                page.fill(field, value)
        page.click("#fault-form [type=submit]")

    def drive_faults(self):
        page = self.page
        late = {"at_s": "100000", "for_s": "5", "ramp_s": "1", "probability": "0.5", "burst": "2", "seed": "7"}
        self.inject("crosstalk", {"value": "-20", "array": "0", "element": "2", "other": "3", **late})
        self.wait_text("#faults", "crosstalk -20 at port 2 and 3")
        kept = self.status()["faults"]["scheduled"]
        self.inject("nav-wrong", {"value": "1", "source": "seapath", "quantity": "heading"})
        self.wait_text("#faults", "nav-wrong 1 at seapath heading")
        self.wait_text("#fault-effect", "This error is added to the quantity.")
        self.assertFalse(page.is_visible("#fault-form [name=element]"))
        # Without a value the browser asks for one; beyond its range the daemon says so beside the form.
        self.inject("gain", {"value": "1000"})
        self.wait_text("#fault-note", "must be from -200 to 100 dB")
        self.assertEqual(self.status()["faults"]["scheduled"], kept + 1)
        page.click("#faults li:first-child button")
        self.wait("() => document.getElementById('faults').children.length === 1")
        page.click("#faults-clear")
        self.wait("() => document.getElementById('faults').children.length === 0")
        for name in late:
            page.fill(f"#fault-form [name={name}]", "")

    def drive_recording(self):
        page = self.page
        self.assertEqual(page.text_content("#record"), "Record")
        self.wait_text("#recording", "off")
        before = set(os.listdir(self.records)) if os.path.isdir(self.records) else set()
        page.click("#record")
        self.wait_text("#recording", "on, ")
        self.wait("() => /on, [1-9]/.test(document.getElementById('recording').textContent)")
        page.click("#record")
        self.wait_text("#recording", "off")
        new = [name for name in set(os.listdir(self.records)) - before if name.endswith(".s7k")]
        self.assertEqual(len(new), 1, new)
        path = os.path.join(self.records, new[0])
        self.rows(2)
        size = os.path.getsize(path)
        self.assertGreater(size, 1000)
        self.rows(4)
        self.assertEqual(os.path.getsize(path), size, "the file is closed")

    def test_keys_work_after_a_click_on_any_control(self):
        page = self.page

        def pauses_and_resumes(what):
            for state in ("paused", "pinging"):
                page.keyboard.press("Space")
                try:
                    self.wait_text("#state", state)
                except Exception as error:
                    raise AssertionError(f"the space bar after a click on {what}") from error
        page.click("#tab-track")
        for place in ("#theme", "#theme", "#wf-truth", "#wf-truth", "#track-in", "#set-gain_db", "#fault-form [name=seed]", "#tab-track", "#wf", "#wf-map", "#trigger"):
            page.click(place)
            if page.evaluate("(place) => document.querySelector(place).tagName", place) == "SELECT":
                page.keyboard.press("Escape")
            pauses_and_resumes(place)
        # A list that was used.
        page.select_option("#wf-rows", "4")
        page.select_option("#wf-rows", "2")
        pauses_and_resumes("#wf-rows")
        # Digits belong to a number field, and to the views elsewhere.
        page.click("#set-gain_db")
        page.keyboard.press("5")
        self.assertEqual(page.input_value("#set-gain_db"), "5")
        self.assertTrue(page.is_visible("#pane-track"))
        page.fill("#set-gain_db", "")
        page.click("#theme")
        page.click("#theme")
        page.keyboard.press("5")
        self.assertTrue(page.is_visible("#pane-motion"))
        page.keyboard.press("4")
        # A button that was reached by Tab keeps the space bar.
        page.focus("#pause")
        page.keyboard.press("Tab")
        page.keyboard.press("Shift+Tab")
        page.keyboard.press("Space")
        self.wait_text("#state", "paused")
        page.keyboard.press("Space")
        self.wait_text("#state", "pinging")

    def test_the_state_is_red_while_a_recording_cannot_go_on(self):
        # A daemon of its own, whose exit status tells of the failure too.
        records = self.records + "-lost"
        daemon = Daemon(self.rig, "sonar.output.sevenk.listen=127.0.0.1:0", "control.listen=127.0.0.1:0", *self.settings, f"record.directory={records}", "record.at_start=true")

        def stop():
            with self.assertRaisesRegex(AssertionError, "hull-.*s7k: cannot"):
                daemon.stop()
        self.addCleanup(stop)
        page = self.open("%s:%d" % daemon.address(r"control http"))
        self.addCleanup(page.close)
        page.wait_for_function("() => /on, [1-9]/.test(document.getElementById('recording').textContent)")
        os.rename(records, records + "-moved")
        # No folder can be made here.
        with open(records, "w", encoding="ascii"):
            pass
        page.wait_for_function("() => document.getElementById('reason').textContent.includes('recording hull.s7k stopped: ')")
        self.assertEqual(page.get_attribute("#verdict", "data-is"), "bad")
        self.assertEqual(page.text_content("#recording"), "stopped by an error")
        page.keyboard.press("6")
        page.wait_for_function("() => document.querySelector('#health .checks').textContent.includes('recording hull.s7k stopped: ')")
        os.remove(records)
        page.wait_for_function("() => !document.getElementById('reason').textContent.includes('stopped')")

    def test_lost_navigation_is_red_with_its_reason(self):
        page = self.page
        self.inject("nav-off", {"source": "seapath", "for_s": "8"})
        self.wait("() => document.getElementById('verdict').dataset.is === 'bad'")
        self.wait("() => /navigation lost|without navigation/.test(document.getElementById('reason').textContent)")
        page.fill("#fault-form [name=for_s]", "")
        page.select_option("#fault-form [name=source]", "")
        page.click("#faults-clear")

    def test_ports_and_what_each_client_gets_are_shown(self):
        page = self.page
        session = reader.Session(self.sevenk, reader.Findings(), gapless=False)
        self.addCleanup(session.close)
        session.command(reader.SUBSCRIBE, struct.pack("<II", 1, 7000))
        self.assertTrue(session.pump(PATIENCE_S, lambda: len(session.pings) > 2))
        page.evaluate("document.activeElement.blur()")
        page.keyboard.press("6")
        host, port = self.sevenk
        self.wait_text("#health", f"{host}:{port}")
        rows = page.evaluate("() => [...document.querySelectorAll('#health > table tbody tr')].map((row) => [...row.cells].map((c) => c.textContent))")
        self.assertEqual(rows, [["7k hull", how, f"{host}:{port}"] for how in ("tcp", "udp")])
        self.wait_text("#health", "gets records 7000")
        own = session.socket.getsockname()[1]
        self.wait("(port) => [...document.querySelectorAll('#health th')].some((th) => th.textContent.includes(`:${port}`) && /^[1-9][.\\d]* \\/s$/.test(th.nextElementSibling.textContent))", own)
        page.keyboard.press("4")

    def test_the_verdict_weighs_what_happened_in_the_last_minute(self):
        counters = {key: 0 for key in ("deadline_misses", "pings_skipped_late", "pings_skipped_nav", "pings_skipped_queue", "pings_truncated", "pings_stretched", "pings_degraded",
                                       "error_check_faults", "worst_late_us", "looser_now")}

        def state(up_s, nav="ok", owners=None, dropped=0, made=None, **changed):
            stream = {"family": "7k", "peer": "TCP 127.0.0.1:9", "records_dropped": dropped}
            sonar = {"name": "hull", "counters": {**counters, "pings_made": int(4 * up_s) if made is None else made, **changed}, "settings": {"pinging": True, "rate_hz": 4},
                     "trigger": "internal", "recording": {"on": True, "files": {}}, "streams": [stream]}
            return {"up_s": up_s, "paused": False, "pipeline_problem": None, "sonars": [sonar], "nav": [{"name": "gps", "state": nav}, {"name": "ins", "state": "ok"}],
                    "nav_owners": owners or {"position": "gps", "heading": "ins"}}

        def verdict(*states):
            return self.page.evaluate("""async (states) => {
                const { Verdict } = await import("/page/verdict.js");
                const verdict = new Verdict();
                for (const state of states) verdict.take(state);
                return [verdict.worst.is, verdict.worst.reasons.join("; ")];
            }""", list(states))
        first = state(10)
        for second, want, why in (
                (state(11), "good", ""),
                (state(11, deadline_misses=3, worst_late_us=7000), "warn", "3 pings late in the last minute, by up to 7.00 ms"),
                (state(11, pings_skipped_late=1), "bad", "1 ping skipped in the last minute (1 not computed in time)"),
                (state(11, pings_skipped_queue=2), "bad", "queue full"),
                (state(11, looser_now=1), "warn", "larger tolerance"),
                (state(11, pings_truncated=1), "warn", "truncated"),
                (state(11, error_check_faults=1), "bad", "above the tolerance"),
                (state(11, dropped=5), "warn", "client 7k TCP 127.0.0.1:9 lost 5 records"),
                (state(11, nav="stale"), "bad", "navigation lost: source gps is stale (position)"),
                (state(11, nav="lost", owners={"heading": "ins"}), "bad", "navigation lost: source gps is lost (position)"),
                (state(11, nav="lost", owners={"position": "ins", "heading": "ins"}), "warn", "another source took over"),
                (state(20, made=40), "bad", "sonar hull has not pinged for 10 s")):
            got = verdict(first, second)
            self.assertEqual(got[0], want, got)
            self.assertIn(why, got[1])
        # A minute later it is history.
        late = {"deadline_misses": 3, "pings_skipped_late": 1, "dropped": 5}
        self.assertEqual(verdict(first, state(11, **late), *(state(t, **late) for t in range(12, 80)))[0], "good")
        self.assertEqual(verdict(first, state(11, **late), *(state(t, **late) for t in range(12, 60)))[0], "bad")

    def test_nothing_is_cut_off_at_any_size(self):
        page = self.open()
        self.addCleanup(page.close)
        for width, height in ((1280, 800), (1920, 1080), (820, 1180)):
            page.set_viewport_size({"width": width, "height": height})
            page.wait_for_timeout(200)
            self.assertLessEqual(page.evaluate("document.documentElement.scrollWidth"), width)
            cut = page.evaluate("""() => [...document.querySelectorAll("button, input, select")].filter((control) => {
                if (control.closest("dialog") || control.offsetParent === null) return false;
                control.scrollIntoView({ block: "nearest" });
                const box = control.getBoundingClientRect();
                const middle = document.elementFromPoint(box.x + box.width / 2, box.y + box.height / 2);
                return box.left < 0 || box.right > innerWidth + 0.5 || !(control === middle || control.contains(middle));
            }).map((control) => control.id || control.name || control.textContent)""")
            self.assertEqual(cut, [], f"controls that cannot be clicked at {width} x {height}")
            for canvas in ("wf", "fan", "track"):
                box = page.locator(f"#{canvas}").bounding_box()
                self.assertTrue(box["width"] >= 250 and box["height"] >= 150, (width, canvas, box))


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
