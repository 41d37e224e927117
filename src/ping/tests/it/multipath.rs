//! Echoes by way of surface and bottom, and the scattering surface: times, levels and statistics against closed forms and integrals.

use std::f64::consts::TAU;
use std::path::Path;

use echotank_config::spec::{RigSpec, SonarSpec};
use echotank_core::ping::PingPlan;
use echotank_core::scene::{MovingScatterer, Scatterers};
use echotank_ping::make_ping;
use echotank_ping::make_ping::{gather, motion};
use echotank_ping::rig::PingSlot;
use echotank_ping::threads::pool;
use echotank_runtime::config_files::parse;
use echotank_runtime::recorded::RecordedRig;
use echotank_scene::draws::{fraction, philox};
use echotank_synthesis::arrivals::{ArrivalChunk, ArrivalSink};
use echotank_synthesis::echo::boundaries::SeaSurface;
use echotank_synthesis::echo::moving::MovingEchoes;
use echotank_synthesis::echo::wind_sea::WindSea;
use echotank_synthesis::echo::{TransmitLeg, Window, Workspace, arrivals, insonify};
use glam::DVec3;
use num_complex::Complex64;

pub(crate) const C: f64 = 1500.0;
pub(crate) const RATE_HZ: f64 = 40e3;
/// Depth of the sonar, metres.
pub(crate) const SONAR_M: f64 = 2.0;

/// A rig of one omnidirectional transmitter and element at [`SONAR_M`]. `range_m` of the ping.
pub(crate) struct Setup<'a> {
    pub(crate) khz: f64,
    pub(crate) range_m: f64,
    /// Lines of `[medium]` and its tables, of `[scene]` and its tables, and of `[sonar.model]`.
    pub(crate) medium: &'a str,
    pub(crate) scene: &'a str,
    pub(crate) model: &'a str,
    /// Lines of transmitter and element.
    pub(crate) patterns: [&'a str; 2],
    /// Speed northward, m/s.
    pub(crate) speed: f64,
}

pub(crate) fn rig(folder: &Path, setup: &Setup) -> RigSpec {
    let track = folder.join("track.csv");
    let mut rows = "time_s,north_m,east_m,down_m,roll_deg,pitch_deg,heading_deg\n".to_owned();
    for k in 0..400 {
        let t = f64::from(k) * 0.5;
        rows += &format!("{t},{},0,0,0,0,0\n", setup.speed * t);
    }
    std::fs::write(&track, rows).expect("a track");
    let Setup {
        khz,
        range_m,
        medium,
        scene,
        model,
        patterns: [sent, received],
        ..
    } = setup;
    let text = format!(
        r#"
[medium]
absorption = "none"
{medium}
[nav]
origin = {{ latitude_deg = 54.3, longitude_deg = 10.2 }}
mode = "settle"
vertical = "depth"
[[nav.source]]
name = "track"
kind = "csv"
path = "{}"
{scene}
[[sonar]]
name = "one"
[sonar.pulse]
kind = "cw"
center_frequency_khz = {khz}
duration_ms = 0.4
taper = 0.0
[[sonar.transmit]]
name = "tx"
position_m = [0.0, 0.0, {SONAR_M}]
{sent}
[[sonar.receive]]
name = "rx"
elements = 1
spacing_m = 0.01
position_m = [0.0, 0.0, {SONAR_M}]
{received}
[sonar.receiver]
sample_rate_khz = 40.0
rx_filter = "none"
noise_db = "none"
[sonar.ping]
range_m = {range_m}
rate_hz = 2.0
source_level_db = 200.0
[sonar.model]
{model}
"#,
        track.display()
    );
    parse(&text, folder).unwrap_or_else(|why| panic!("{why}"))
}

pub(crate) const DIRECT: &str =
    "path = \"k-segment\"\ndoppler = \"stretch\"\nsynthesis = \"direct\"";

pub(crate) const OMNI: [&str; 2] = ["", "element_pattern = \"omnidirectional\""];

fn plane(depth_m: f64, more: &str) -> String {
    format!(
        "[scene]\nocclusion = \"none\"\n[scene.seabed]\nshape = \"plane\"\ndepth_m = {depth_m}\n{more}"
    )
}

/// Makes pings 1 to `last` and looks at each.
pub(crate) fn pings(spec: &RigSpec, last: u32, mut look: impl FnMut(u32, &PingSlot, &Scatterers)) {
    let mut recorded = RecordedRig::open(spec).expect("opens");
    let mut slot = recorded.rig.slot(0);
    for ping in 1..=last {
        let (sonar, order) = recorded.next_order(last).expect("an order");
        assert!(recorded.settle(sonar, &order));
        let (mode, utc) = (spec.nav.mode, order.transmit_utc);
        make_ping(&mut recorded.rig, sonar, &order, mode, utc, &mut slot).expect("a ping");
        look(ping, &slot, recorded.rig.scatterers());
    }
}

/// Motion and scatterers of some pings, without their echoes.
pub(crate) fn gather_pings(
    spec: &RigSpec,
    pings: u32,
    mut look: impl FnMut(&PingPlan, &Scatterers) + Send,
) {
    pool(2).expect("threads").install(|| {
        let mut recorded = RecordedRig::open(spec).expect("opens");
        let mut slot = recorded.rig.slot(0);
        for _ in 0..pings {
            let (sonar, order) = recorded.next_order(pings).expect("an order");
            assert!(recorded.settle(sonar, &order));
            let (mode, utc) = (spec.nav.mode, order.transmit_utc);
            motion(&mut recorded.rig, sonar, &order, mode, utc, &mut slot).expect("motion");
            gather(&mut recorded.rig, sonar, &mut slot);
            look(&slot.plan, recorded.rig.scatterers());
        }
    });
}

/// Rayleigh reflection at the vertical by a fluid without loss.
fn at_vertical(density: f64, speed: f64) -> f64 {
    (density * speed - 1.0) / (density * speed + 1.0)
}

/// One point on a bottom straight below the sonar, under a calm surface: every pair of legs at its time, with its level.
#[test]
fn echoes_of_a_point_come_at_the_times_and_levels_of_its_images() {
    const BOTTOM_M: f64 = 20.0;
    let folder = tempfile::tempdir().expect("a folder");
    let points = folder.path().join("points.csv");
    std::fs::write(
        &points,
        format!("north_m,east_m,down_m,amplitude\n0,0,{BOTTOM_M},1\n"),
    )
    .expect("points");
    let scene = format!(
        "[scene]\nocclusion = \"none\"\npoints = \"{}\"\n[scene.seabed]\nshape = \"plane\"\ndepth_m = {BOTTOM_M}\nlambert_db = -100.0\ndensity_per_m2 = 0.01",
        points.display()
    );
    let setup = Setup {
        khz: 50.0,
        range_m: 62.0,
        medium: "[medium.multipath]\nbottom_density_ratio = 2.0\nbottom_speed_ratio = 1.2\nbottom_roughness_m = 0.0",
        scene: &scene,
        model: DIRECT,
        patterns: OMNI,
        speed: 0.0,
    };
    let spec = rig(folder.path(), &setup);
    pool(2).expect("threads").install(|| {
        pings(&spec, 1, |_, slot, _| {
            assert!(slot.output.scene.images > 0);
            let samples = slot.output.elements[0].element(0);
            let rate_hz = RATE_HZ;
            let source = 10f64.powf(200.0 / 20.0);
            let gain = 10f64.powf(spec.sonars[0].receive[0].sensitivity_db / 20.0);
            let direct_m = BOTTOM_M - SONAR_M;
            let surface_m = BOTTOM_M + SONAR_M;
            let second_m = 3.0 * BOTTOM_M - SONAR_M;
            let bottom = at_vertical(2.0, 1.2);
            // Sand has a loss of 0.016, which changes the coefficient by 1e-4.
            for (name, out_m, back_m, coefficient, orders) in [
                ("D D", direct_m, direct_m, 1.0, 1.0),
                ("D S", direct_m, surface_m, 1.0, 2.0),
                ("S S", surface_m, surface_m, 1.0, 1.0),
                ("D SB", direct_m, second_m, bottom, 2.0),
                ("S SB", surface_m, second_m, bottom, 2.0),
                ("SB SB", second_m, second_m, bottom * bottom, 1.0),
            ] {
                let delay_s = (out_m + back_m) / C;
                let want = orders * source * gain * coefficient / (out_m * back_m);
                let first = (delay_s - slot.plan.first_sample_s) * rate_hz;
                let k = first.ceil() as usize;
                let inside = &samples[k + 1..k + 6];
                let level = inside.iter().map(|x| x.norm()).sum::<f64>() / inside.len() as f64;
                let off_db = 20.0 * (level / want).log10();
                println!("{name}: {off_db:+.3} dB at {delay_s:.5} s");
                assert!(off_db.abs() < 0.1, "{name}: {off_db} dB");
                // Nothing two samples before, all of it one sample after.
                assert!(samples[k - 2].norm() < 0.02 * want, "{name} begins early");
            }
        });
    });
}

/// A leg through water of one gradient: spans of depths, each passed without a turn, by sums over thin layers.
struct LayeredLeg {
    time_s: f64,
    /// Pressure of the ray tube.
    spreading_per_m: f64,
    /// Sine of the elevation at the bottom.
    bottom_sine: f64,
}

impl LayeredLeg {
    fn new(
        speed: impl Fn(f64) -> f64,
        spans: &[(f64, f64)],
        ends: (f64, f64),
        range_m: f64,
        bottom_m: f64,
    ) -> Self {
        const LAYERS: usize = 4000;
        let sums = |p: f64| {
            let [mut range_m, mut time_s, mut per_p, mut by_p] = [0.0; 4];
            for &(upper_m, lower_m) in spans {
                let dz = (lower_m - upper_m) / LAYERS as f64;
                for k in 0..LAYERS {
                    let c = speed(upper_m + (k as f64 + 0.5) * dz);
                    let s = (1.0 - (p * c).powi(2)).sqrt();
                    range_m += p * c / s * dz;
                    time_s += dz / (c * s);
                    per_p += c / s * dz;
                    by_p += c / s.powi(3) * dz;
                }
            }
            [range_m, time_s, per_p, by_p]
        };
        let (mut low, mut high) = (0.0, 0.9 / 1500.0);
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            match sums(middle)[0] < range_m {
                true => low = middle,
                false => high = middle,
            }
        }
        let p = if range_m == 0.0 {
            0.0
        } else {
            0.5 * (low + high)
        };
        let [_, time_s, per_p, by_p] = sums(p);
        let sine = |z: f64| (1.0 - (p * speed(z)).powi(2)).sqrt();
        let (c1, c2) = (speed(ends.0), speed(ends.1));
        let tube = per_p * by_p * sine(ends.0) * sine(ends.1);
        Self {
            time_s,
            spreading_per_m: (c1 * c2 / tube).sqrt(),
            bottom_sine: sine(bottom_m),
        }
    }
}

/// Two points on a bottom, below the sonar and beside it, in water whose sound speed falls with depth: echoes by the surface, and second bottom echoes, come
/// within a sample of their rays and with the levels of their tubes. Straight images would be more than ten samples early.
#[test]
fn reflected_echoes_through_a_gradient_come_with_the_times_and_levels_of_their_rays() {
    const BOTTOM_M: f64 = 20.0;
    const GRADIENT: f64 = -1.0;
    let speed = |z: f64| 1500.0 + GRADIENT * z;
    let folder = tempfile::tempdir().expect("a folder");
    let points = folder.path().join("points.csv");
    let text = format!("north_m,east_m,down_m,amplitude\n0,0,{BOTTOM_M},1\n10,0,{BOTTOM_M},1\n");
    std::fs::write(&points, text).expect("points");
    let scene = format!(
        "[scene]\nocclusion = \"none\"\npoints = \"{}\"\n[scene.seabed]\nshape = \"plane\"\ndepth_m = {BOTTOM_M}\nlambert_db = -100.0\ndensity_per_m2 = 0.01",
        points.display()
    );
    let medium = format!(
        "profile = {{ points = [[0.0, {}], [40.0, {}]] }}\n[medium.multipath]\nbottom_density_ratio = 2.0\nbottom_speed_ratio = 1.2\nbottom_roughness_m = 0.0",
        speed(0.0),
        speed(40.0)
    );
    let setup = Setup {
        khz: 50.0,
        range_m: 62.0,
        medium: &medium,
        scene: &scene,
        model: DIRECT,
        patterns: OMNI,
        speed: 0.0,
    };
    let spec = rig(folder.path(), &setup);
    let leg = |spans: &[(f64, f64)], range_m: f64| {
        LayeredLeg::new(speed, spans, (SONAR_M, BOTTOM_M), range_m, BOTTOM_M)
    };
    pool(2).expect("threads").install(|| {
        pings(&spec, 1, |_, slot, _| {
            assert!(slot.output.scene.images > 0);
            let samples = slot.output.elements[0].element(0);
            let source = 10f64.powf(200.0 / 20.0);
            let gain = 10f64.powf(spec.sonars[0].receive[0].sensitivity_db / 20.0);
            for range_m in [0.0, 10.0] {
                let direct = leg(&[(SONAR_M, BOTTOM_M)], range_m);
                let surface = leg(&[(0.0, SONAR_M), (0.0, BOTTOM_M)], range_m);
                let spans = [(SONAR_M, BOTTOM_M), (0.0, BOTTOM_M), (0.0, BOTTOM_M)];
                let second = leg(&spans, range_m);
                let s = second.bottom_sine;
                let inside = (1.0 / (1.2f64 * 1.2) - (1.0 - s * s)).sqrt();
                let bottom = (2.0 * s - inside) / (2.0 * s + inside);
                for (name, out, back, coefficient, straight_m) in [
                    ("D S", &direct, &surface, 1.0, 2.0 * BOTTOM_M),
                    (
                        "D SB",
                        &direct,
                        &second,
                        bottom,
                        4.0 * BOTTOM_M - 2.0 * SONAR_M,
                    ),
                ] {
                    let delay_s = out.time_s + back.time_s;
                    let spreading = out.spreading_per_m * back.spreading_per_m;
                    // A pair and its reverse add up.
                    let want = 2.0 * source * gain * coefficient * spreading;
                    let first = (delay_s - slot.plan.first_sample_s) * RATE_HZ;
                    let k = first.ceil() as usize;
                    let inside = &samples[k + 1..k + 6];
                    let level = inside.iter().map(|x| x.norm()).sum::<f64>() / inside.len() as f64;
                    let off_db = 20.0 * (level / want).log10();
                    println!("{range_m} m, {name}: {off_db:+.3} dB at {delay_s:.6} s");
                    assert!(off_db.abs() < 0.1, "{range_m} m, {name}: {off_db} dB");
                    assert!(samples[k - 2].norm() < 0.02 * want, "{name} begins early");
                    if range_m == 0.0 {
                        let straight_s = straight_m / speed(SONAR_M);
                        let early = (delay_s - straight_s) * RATE_HZ;
                        assert!(
                            early > if name == "D S" { 5.0 } else { 10.0 },
                            "{early} samples"
                        );
                    }
                }
            }
        });
    });
}

/// Sums of echoes in range cells of half the path.
struct Cells {
    first_m: f64,
    cell_m: f64,
    carrier_hz: f64,
    sums: Vec<Complex64>,
}

impl ArrivalSink for Cells {
    fn accept(&mut self, chunk: &ArrivalChunk) {
        for i in 0..chunk.len {
            let cell = ((0.5 * C * chunk.delay_s[i] - self.first_m) / self.cell_m).floor();
            if (0.0..self.sums.len() as f64).contains(&cell) {
                let turns = self.carrier_hz * chunk.delay_s[i];
                let phase = -TAU * (turns - turns.round());
                self.sums[cell as usize] += chunk.amplitude[i] * Complex64::cis(phase);
            }
        }
    }
}

impl Cells {
    /// Intensities over those of a source of 1 m strength 1, of the scatterers given.
    fn of(&mut self, spec: &RigSpec, plan: &PingPlan, scatterers: &Scatterers) -> Vec<f64> {
        self.sums.fill(Complex64::ZERO);
        let sonar = &spec.sonars[0];
        let mut leg = TransmitLeg::new();
        let window = Window {
            first_s: 0.0,
            last_s: 0.2,
        };
        insonify(plan, &sonar.transmit[0], window, scatterers, &mut leg);
        let mut work = Workspace::new();
        arrivals(plan, &sonar.receive[0], 0, &leg, &mut work, self);
        let mut moving = MovingEchoes::default();
        moving.prepare(
            plan,
            &sonar.transmit,
            &sonar.receive,
            &scatterers.moving,
            0.0,
        );
        moving.arrivals(plan, (0, &sonar.receive[0]), 0, self);
        let gain_db = 200.0 + sonar.receive[0].sensitivity_db;
        let unit = 10f64.powf(-gain_db / 10.0);
        self.sums.iter().map(|sum| sum.norm_sqr() * unit).collect()
    }
}

/// Kolmogorov's probability that intensities over their means are exponential, which those of a Rayleigh envelope are.
fn rayleigh(values: Vec<f64>) -> f64 {
    kolmogorov(values, |x| 1.0 - (-x).exp())
}

/// Kolmogorov's probability that independent values have a law, given by its distribution function.
fn kolmogorov(mut values: Vec<f64>, law: impl Fn(f64) -> f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len() as f64;
    let apart = values.iter().enumerate().map(|(k, x)| {
        let law = law(*x);
        (law - k as f64 / n)
            .abs()
            .max(((k + 1) as f64 / n - law).abs())
    });
    let lambda = apart.fold(0.0, f64::max) * (n.sqrt() + 0.12 + 0.11 / n.sqrt());
    let terms = (1..50).map(|k| {
        let k = f64::from(k);
        let sign = if k as i32 % 2 == 1 { 1.0 } else { -1.0 };
        2.0 * sign * (-2.0 * (k * lambda).powi(2)).exp()
    });
    terms.sum::<f64>().clamp(0.0, 1.0)
}

/// The echoes of one pair of legs, told by the depths of their images.
fn only(all: &Scatterers, is_wanted: impl Fn(f64, f64) -> bool) -> Scatterers {
    let mut some = Scatterers {
        curve: all.curve.clone(),
        ..Scatterers::default()
    };
    for i in all.of_scene()..all.len() {
        let (out_m, back_m) = (all.transmit_m(i).z, all.position_m(i).z);
        if is_wanted(out_m, back_m) {
            some.push_copy(all, i, 1.0);
        }
    }
    some
}

/// The second bottom echo under a rough surface at 12, 100 and 400 kHz, against the integral over the images of a Lambert bottom: at 12 kHz mostly
/// coherent, at 100 and 400 kHz incoherent alone. Of one pair of legs: how a pair and its reverse add up depends on the motion between them, and the test of
/// a point has both.
#[test]
fn the_second_bottom_echo_has_the_level_of_the_images_at_12_100_and_400_khz() {
    const BOTTOM_M: f64 = 10.0;
    const MU_DB: f64 = -20.0;
    const PINGS: u32 = 24;
    const CELL_M: f64 = 0.1;
    let (density, speed) = (1.9, 1.15);
    let folder = tempfile::tempdir().expect("a folder");
    let first_m = 0.5 * (4.0 * BOTTOM_M - 2.0 * SONAR_M);
    let cells = 30;
    // D and SB of ground at `y` metres beside the sonar.
    let lengths = |y: f64| {
        let (up_m, image_m) = (BOTTOM_M - SONAR_M, 3.0 * BOTTOM_M - SONAR_M);
        (y.hypot(up_m), y.hypot(image_m), up_m, image_m)
    };
    let mut want = vec![0.0; cells];
    let dy = 1e-4;
    for k in 0..150_000 {
        let y = (f64::from(k) + 0.5) * dy;
        let (direct_m, second_m, up_m, image_m) = lengths(y);
        let (cos_in, cos_out) = (up_m / direct_m, image_m / second_m);
        // Rayleigh reflection of the SB leg; its grazing angle has the sine cos_out.
        let kappa2 = 1.0 / (speed * speed) - (1.0 - cos_out * cos_out);
        let (a, b) = (density * cos_out, kappa2.sqrt());
        let power = ((a - b) / (a + b)).powi(2);
        let mu = 10f64.powf(MU_DB / 10.0);
        let share = mu * cos_in * cos_out * power / (direct_m * second_m).powi(2);
        let cell = ((0.5 * (direct_m + second_m) - first_m) / CELL_M).floor() as usize;
        if cell < cells {
            want[cell] += share * TAU * y * dy;
        }
    }
    let scene = plane(
        BOTTOM_M,
        &format!("lambert_db = {MU_DB}\ndensity_per_m2 = 40.0"),
    );
    for khz in [12.0, 100.0, 400.0] {
        let medium = format!(
            "wind_m_per_s = 0.0\n[medium.surface]\nroughness_m = 0.005\nslope_deg = 4.0\n[medium.multipath]\nbottom_density_ratio = {density}\nbottom_speed_ratio = {speed}\nbottom_roughness_m = 0.002\nbottom_slope_deg = 2.0"
        );
        let setup = Setup {
            khz,
            range_m: 22.0,
            medium: &medium,
            scene: &scene,
            model: DIRECT,
            patterns: OMNI,
            speed: 3.0,
        };
        let spec = rig(folder.path(), &setup);
        let mut sums = Cells {
            first_m,
            cell_m: CELL_M,
            carrier_hz: 1e3 * khz,
            sums: vec![Complex64::ZERO; cells],
        };
        let mut relative = Vec::new();
        gather_pings(&spec, PINGS, |plan, all| {
            let second = only(all, |out_m, back_m| {
                (out_m - BOTTOM_M).abs() < 1e-6 && back_m > 2.0 * BOTTOM_M
            });
            let got = sums.of(&spec, plan, &second);
            relative.extend(got.iter().zip(&want).map(|(got, want)| got / want));
        });
        let mean = relative.iter().sum::<f64>() / relative.len() as f64;
        let off_db = 10.0 * mean.log10();
        // A ping repeats little of the ground of the one before.
        let p = rayleigh(relative.iter().map(|x| x / mean).collect());
        println!("{khz} kHz: {off_db:+.2} dB of the integral, Rayleigh p = {p:.2}");
        assert!(off_db.abs() < 0.5, "{khz} kHz: {off_db} dB");
        assert!(p > 0.01, "{khz} kHz: p = {p}");
    }
}

/// The surface above the sonar, without a seabed: level of every range cell against the integral of its strength, Rayleigh statistics, the first return
/// at a slant range of the depth, and pings that are independent after two correlation times.
#[test]
fn the_surface_scatters_at_its_strength_from_its_depth_on_and_decorrelates() {
    const CELL_M: f64 = 0.05;
    const PINGS: u32 = 12;
    let folder = tempfile::tempdir().expect("a folder");
    let wind = 8.0;
    for (khz, waves) in [(30.0, false), (400.0, false), (400.0, true)] {
        let medium = format!(
            "wind_m_per_s = {wind}\n[medium.surface]\nscattering = true\nwaves = {waves}\ncorrelation_time_ms = 40.0"
        );
        // The seabed sets the density of the surface's scatterers and is out of range.
        let scene = plane(60.0, "density_per_m2 = 60.0");
        let setup = Setup {
            khz,
            range_m: 12.0,
            medium: &medium,
            scene: &scene,
            model: DIRECT,
            patterns: OMNI,
            speed: 0.0,
        };
        let spec = rig(folder.path(), &setup);
        let surface = SeaSurface::of_wind(wind);
        let (first_m, cells) = (SONAR_M, 160);
        let want: Vec<f64> = (0..cells)
            .map(|k| {
                // dA = 2 pi r dr; every echo has r^-4.
                let steps = 200;
                let of = |i: usize| {
                    let r = first_m + CELL_M * (k as f64 + (i as f64 + 0.5) / f64::from(steps));
                    let strength = surface.strength(1e3 * khz, SONAR_M / r);
                    strength * TAU * r.powi(-3) * CELL_M / f64::from(steps)
                };
                (0..steps as usize).map(of).sum()
            })
            .collect();
        let mut sums = Cells {
            first_m,
            cell_m: CELL_M,
            carrier_hz: 1e3 * khz,
            sums: vec![Complex64::ZERO; cells],
        };
        let (mut relative, mut early) = (Vec::new(), 0.0f64);
        pool(2).expect("threads").install(|| {
            pings(&spec, PINGS, |_, slot, scatterers| {
                assert_eq!(scatterers.of_scene(), 0);
                let (still, moving) = (scatterers.len(), scatterers.moving.len());
                assert_eq!(slot.output.scene.surface as usize, still + moving);
                assert_eq!(if waves { still } else { moving }, 0);
                let got = sums.of(&spec, &slot.plan, scatterers);
                relative.extend(got.iter().zip(&want).map(|(got, want)| got / want));
                let samples = slot.output.elements[0].element(0);
                let first =
                    ((2.0 * SONAR_M / C - slot.plan.first_sample_s) * RATE_HZ).floor() as usize;
                early = samples[..first]
                    .iter()
                    .map(|x| x.norm())
                    .fold(early, f64::max);
                let heard = samples[first..first + 4].iter().map(|x| x.norm());
                assert!(heard.fold(0.0, f64::max) > 0.0, "heard at the depth");
            });
        });
        assert_eq!(early, 0.0, "nothing is nearer than the surface");
        let mean = relative.iter().sum::<f64>() / relative.len() as f64;
        let off_db = 10.0 * mean.log10();
        let p = rayleigh(relative.iter().map(|x| x / mean).collect());
        println!("{khz} kHz, waves {waves}: {off_db:+.2} dB of the integral, Rayleigh p = {p:.2}");
        assert!(off_db.abs() < 0.5, "{khz} kHz: {off_db} dB");
        // The still platform sees the same places in every ping, half a second apart: were they not drawn anew, all pings would agree.
        assert!(p > 0.01, "{khz} kHz: p = {p}");
    }
}

/// Doppler, delay and intensity of the echoes of moving scatterers at the first element.
fn dopplers(sonar: &SonarSpec, plan: &PingPlan, moving: &[MovingScatterer]) -> Vec<[f64; 3]> {
    let mut echoes = MovingEchoes::default();
    echoes.prepare(plan, &sonar.transmit, &sonar.receive, moving, 0.0);
    let mut dopplers = Dopplers::default();
    echoes.arrivals(plan, (0, &sonar.receive[0]), 0, &mut dopplers);
    dopplers.echoes
}

/// A sea surface above deep water, seen without patterns at 100 kHz; `more`: keys of [medium.surface].
fn waving(folder: &Path, wind_m_per_s: f64, more: &str) -> RigSpec {
    let medium = format!(
        "wind_m_per_s = {wind_m_per_s}\n[medium.surface]\nscattering = true\nwaves = true\n{more}"
    );
    let setup = Setup {
        khz: 100.0,
        range_m: 12.0,
        medium: &medium,
        scene: &plane(60.0, "density_per_m2 = 4.0"),
        model: DIRECT,
        patterns: OMNI,
        speed: 0.0,
    };
    rig(folder, &setup)
}

/// Doppler of the echoes of one ping, with their delays and intensities.
#[derive(Default)]
struct Dopplers {
    echoes: Vec<[f64; 3]>,
}

impl ArrivalSink for Dopplers {
    fn accept(&mut self, chunk: &ArrivalChunk) {
        for i in 0..chunk.len {
            let intensity = chunk.amplitude[i].norm_sqr();
            self.echoes
                .push([chunk.doppler[i], chunk.delay_s[i], intensity]);
        }
    }
}

/// Variance of the vertical velocity of a sea under so much wind, m^2/s^2: 4.17e-3 U^2 (Pierson and Moskowitz 1964).
fn vertical_variance(wind_m_per_s: f64) -> f64 {
    8.1e-3 * std::f64::consts::PI.sqrt() * wind_m_per_s.powi(2) / (4.0 * 0.74f64.sqrt())
}

/// The Doppler of echoes from a surface with waves: Gaussian, with the variance of the orbital velocity along the ray, m2 sin^2 + (m2 / 2) cos^2 of the
/// elevation, m2 = 4.17e-3 U^2 (Pierson and Moskowitz).
#[test]
fn waves_spread_the_doppler_of_the_surface_by_their_orbital_velocity() {
    const PINGS: u32 = 390;
    const WIND: f64 = 4.0;
    let folder = tempfile::tempdir().expect("a folder");
    let spec = waving(folder.path(), WIND, "");
    let m2 = vertical_variance(WIND);
    let (mut sum, mut weight, mut apart) = (0.0, 0.0, Vec::new());
    let mut ping = 0;
    gather_pings(&spec, PINGS, |plan, all| {
        let sonar = &spec.sonars[0];
        let echoes = dopplers(sonar, plan, &all.moving);
        assert!(echoes.len() > 100);
        // Radial velocity over its predicted deviation.
        let of = |[doppler, delay_s, _]: [f64; 3]| {
            let sine = SONAR_M / (0.5 * C * delay_s);
            let variance = m2 * (sine * sine + 0.5 * (1.0 - sine * sine));
            0.5 * C * doppler / variance.sqrt()
        };
        for echo in &echoes {
            sum += of(*echo).powi(2) * echo[2];
            weight += echo[2];
        }
        // Every two seconds one echo, of another place.
        if ping % 4 == 0 {
            let k = (ping as usize * 7919) % echoes.len();
            apart.push(of(echoes[k]));
        }
        ping += 1;
    });
    let ratio = sum / weight;
    let p = kolmogorov(apart, |x| 0.5 * (1.0 + libm::erf(x / 2f64.sqrt())));
    println!("variance {ratio:.3} of the predicted one, Gaussian p = {p:.2}");
    assert!((ratio - 1.0).abs() < 0.12, "{ratio}");
    assert!(p > 0.01, "p = {p}");
}

/// In wind of one direction, mean and variance of the Doppler in four directions of look are those of the spectrum and its directions: a drift of
/// 0.0134 U cos(angle) with the wind, and m2 sin^2 + m2 (3/4 cos^2 + 1/4 sin^2 of the angle) cos^2 of the elevation.
#[test]
fn the_doppler_of_the_surface_depends_on_the_direction_of_look() {
    const WIND: f64 = 4.0;
    let folder = tempfile::tempdir().expect("a folder");
    let spec = waving(folder.path(), WIND, "wind_from_deg = 200.0");
    let m2 = vertical_variance(WIND);
    // Towards 20 degrees.
    let with_wind = DVec3::new(20f64.to_radians().cos(), 20f64.to_radians().sin(), 0.0);
    let mut sums = [[0.0; 5]; 4];
    gather_pings(&spec, 390, |plan, all| {
        let sonar = &spec.sonars[0];
        let echoes = dopplers(sonar, plan, &all.moving);
        for ([doppler, _, intensity], s) in echoes.iter().zip(&all.moving) {
            let ray =
                (s.position_m + s.velocity_m_per_s * s.hit_s - DVec3::Z * SONAR_M).normalize();
            let level = ray.truncate().normalize();
            let (along, across) = (
                level.dot(with_wind.truncate()),
                level.perp_dot(with_wind.truncate()),
            );
            let cos2 = 1.0 - ray.z * ray.z;
            let sector = match (along.abs() > 0.94, across.abs() > 0.94) {
                (true, _) => usize::from(along < 0.0),
                (_, true) => 2 + usize::from(across < 0.0),
                _ => continue,
            };
            if cos2 < 0.5 {
                continue;
            }
            let radial = -0.5 * C * doppler;
            let drift = 0.0134 * WIND * along * cos2.sqrt();
            let variance =
                m2 * (1.0 - cos2 + cos2 * (0.75 * along * along + 0.25 * across * across));
            let sums = &mut sums[sector];
            sums[0] += intensity;
            sums[1] += intensity * radial;
            sums[2] += intensity * drift;
            sums[3] += intensity * (radial - drift).powi(2);
            sums[4] += intensity * variance;
        }
    });
    for (name, [weight, radial, drift, square, variance]) in
        ["downwind", "upwind", "across", "across"]
            .into_iter()
            .zip(sums)
    {
        let (mean, want) = (radial / weight, drift / weight);
        let ratio = square / variance;
        let deviation = (variance / weight).sqrt();
        println!(
            "{name}: mean {mean:+.4} m/s, predicted {want:+.4}; deviation {deviation:.3} m/s, variance {ratio:.3} of the predicted one"
        );
        assert!((mean - want).abs() < 0.005, "{name}: {mean} {want}");
        assert!((ratio - 1.0).abs() < 0.08, "{name}: {ratio}");
    }
    // In the wind and across it they differ.
    assert!(sums[0][3] / sums[0][0] > 1.5 * sums[2][3] / sums[2][0]);
}

/// The echo of a point that the surface reflects twice has the phase of the surface's height at the places and the times of both reflections, ping by ping.
#[test]
fn heights_move_the_image_by_the_surface_at_the_place_and_time_of_the_reflection() {
    const BOTTOM_M: f64 = 20.0;
    const EAST_M: f64 = 18.0;
    const WIND: f64 = 8.0;
    let folder = tempfile::tempdir().expect("a folder");
    let points = folder.path().join("points.csv");
    std::fs::write(
        &points,
        format!("north_m,east_m,down_m,amplitude\n0,{EAST_M},{BOTTOM_M},1\n"),
    )
    .expect("points");
    let scene = format!(
        "[scene]\nocclusion = \"none\"\npoints = \"{}\"",
        points.display()
    );
    for water in [
        "",
        "profile = { points = [[0.0, 1500.0], [60.0, 1500.0]] }\n",
    ] {
        let medium = format!(
            "{water}wind_m_per_s = {WIND}\n[medium.surface]\nroughness_m = 0.0\nheights = true\nwind_from_deg = 40.0\n[medium.multipath]\nlegs = \"surface\""
        );
        let setup = Setup {
            khz: 12.0,
            range_m: 32.0,
            medium: &medium,
            scene: &scene,
            model: DIRECT,
            patterns: OMNI,
            speed: 0.0,
        };
        let spec = rig(folder.path(), &setup);
        let key = [spec.scene.seed as u32, (spec.scene.seed >> 32) as u32];
        let sea = WindSea::new(WIND, Some(40f64.to_radians()), |i| {
            fraction(philox([i, 0, 0x3A7E, 0x5EA5_0FAC], key)[0])
        });
        // Longer than eight depths of the sonar.
        let longer_m = 8.0 * SONAR_M;
        let (mut worst, mut least_m, mut most_m) = (0.0f64, f64::INFINITY, f64::NEG_INFINITY);
        pool(2).expect("threads").install(|| {
            pings(&spec, 60, |_, slot, _| {
                let plan = &slot.plan;
                let utc_s = plan.transmit_utc.0 as f64 * 1e-9;
                let share = SONAR_M / (SONAR_M + BOTTOM_M);
                let height_m = |after_s: f64| {
                    sea.height_m(0.0, share * EAST_M, utc_s + after_s, longer_m)
                        .0
                };
                let flat_m = EAST_M.hypot(SONAR_M + BOTTOM_M);
                let leg_m = |h: f64| EAST_M.hypot(SONAR_M + BOTTOM_M + 2.0 * h);
                let first_s = share * flat_m / C;
                let out_m = leg_m(height_m(first_s));
                let back_m = leg_m(height_m((2.0 * flat_m) / C - first_s));
                let delay_s = (out_m + back_m) / C;
                least_m = least_m.min(out_m + back_m);
                most_m = most_m.max(out_m + back_m);
                let k = ((delay_s + 2e-4 - plan.first_sample_s) * RATE_HZ).round() as usize;
                let sample = slot.output.elements[0].element(0)[k];
                // Two reflections turn the phase by a whole turn.
                let cycles = -12e3 * delay_s;
                let want = Complex64::cis(TAU * (cycles - cycles.round()));
                worst = worst.max((sample / want).arg().abs() / TAU);
            });
        });
        println!(
            "phase within {worst:.1e} of a wavelength, while the path changes by {:.2} m",
            most_m - least_m
        );
        assert!(worst < 1e-3, "{worst}");
        assert!(most_m - least_m > 0.5, "the surface moves");
    }
}

/// The Doppler of bottom echoes by a surface with waves: Gaussian, with the variance (2 sin psi)^2 m2 of the vertical velocity of the facets. A pulse
/// too short to resolve it has the same echoes at rest, with the same energy.
#[test]
fn waves_spread_the_doppler_of_reflections_by_their_vertical_velocity() {
    const PINGS: u32 = 390;
    const WIND: f64 = 4.0;
    const BOTTOM_M: f64 = 8.0;
    let folder = tempfile::tempdir().expect("a folder");
    let setup = Setup {
        khz: 100.0,
        range_m: 14.0,
        medium: &format!(
            "wind_m_per_s = {WIND}\n[medium.surface]\nscattering = true\nwaves = true\n[medium.multipath]\nlegs = \"surface\""
        ),
        scene: &plane(BOTTOM_M, "density_per_m2 = 0.5\nlambert_db = -20.0"),
        model: DIRECT,
        patterns: OMNI,
        speed: 0.0,
    };
    let short = rig(folder.path(), &setup);
    let mut long = short.clone();
    // 100 Hz wide; the waves spread the Doppler by some 30 Hz a leg.
    long.sonars[0].settings.pulse_duration_s = 0.01;
    let sonar = &long.sonars[0];
    let m2 = vertical_variance(WIND);
    let echoes = |plan: &PingPlan, list: &[MovingScatterer]| dopplers(sonar, plan, list);
    // In a part of both windows.
    let inside = |echoes: &[[f64; 3]]| {
        let some = echoes.iter().filter(|echo| 0.5 * C * echo[1] < 12.5);
        some.map(|echo| echo[2]).sum::<f64>()
    };
    let (mut sum, mut weight, mut apart, mut energy) = (0.0, 0.0, Vec::new(), 0.0);
    let mut ping = 0;
    gather_pings(&long, PINGS, |plan, all| {
        assert_eq!(all.of_scene(), all.len(), "all images move");
        let images = all.moving.iter().filter(|s| s.transmit.is_some());
        let list: Vec<MovingScatterer> = images.clone().copied().collect();
        energy += inside(&echoes(plan, &list));
        // The scatterer and its image by the surface, as it is before facets bend the path.
        let legs = |s: &MovingScatterer| {
            let sent_m = s.transmit.expect("an image").position_m;
            let [one, other] = [sent_m.z, s.position_m.z].map(|z| (z - BOTTOM_M).abs() < 1e-9);
            match (one, other) {
                (true, false) => Some(sent_m),
                (false, true) => Some(s.position_m),
                _ => None,
            }
        };
        let mixed: Vec<(MovingScatterer, DVec3)> =
            images.filter_map(|s| Some((*s, legs(s)?))).collect();
        let list: Vec<MovingScatterer> = mixed.iter().map(|(s, _)| *s).collect();
        assert!(list.len() > 100);
        let made = echoes(plan, &list);
        // Radial velocity over its predicted deviation.
        let of = |k: usize| {
            let at_m = mixed[k].1;
            let height_m = BOTTOM_M + SONAR_M;
            let sine = height_m / height_m.hypot(at_m.truncate().length());
            C * made[k][0] / (2.0 * sine * m2.sqrt())
        };
        for (k, echo) in made.iter().enumerate() {
            sum += of(k).powi(2) * echo[2];
            weight += echo[2];
        }
        if ping % 4 == 0 {
            apart.push(of((ping as usize * 7919) % made.len()));
        }
        ping += 1;
    });
    let ratio = sum / weight;
    let p = kolmogorov(apart, |x| 0.5 * (1.0 + libm::erf(x / 2f64.sqrt())));
    println!("variance {ratio:.3} of the predicted one, Gaussian p = {p:.2}");
    assert!((ratio - 1.0).abs() < 0.12, "{ratio}");
    assert!(p > 0.01, "{p}");
    let mut at_rest = 0.0;
    gather_pings(&short, PINGS, |plan, all| {
        assert!(all.moving.iter().all(|s| s.transmit.is_none()));
        let sonar = &short.sonars[0];
        let images = only(all, |_, _| true);
        let mut leg = TransmitLeg::new();
        let window = Window {
            first_s: 0.0,
            last_s: 0.2,
        };
        insonify(plan, &sonar.transmit[0], window, &images, &mut leg);
        let (mut work, mut still) = (Workspace::new(), Dopplers::default());
        arrivals(plan, &sonar.receive[0], 0, &leg, &mut work, &mut still);
        at_rest += inside(&still.echoes);
    });
    let off_db = 10.0 * (energy / at_rest).log10();
    println!("energy {off_db:+.2} dB of that at rest");
    assert!(off_db.abs() < 0.5, "{off_db} dB");
}

/// A path that facets bend is longer than the mirror path, by (geometric optics of one reflection) 4 s^2 r_1 r_2 / (2 L) in the mean at the vertical, with
/// s the rms slope in both directions.
#[test]
fn rough_paths_are_longer_by_what_the_slopes_say() {
    const BOTTOM_M: f64 = 10.0;
    let folder = tempfile::tempdir().expect("a folder");
    let slope = 3f64.to_radians();
    let setup = Setup {
        khz: 400.0,
        range_m: 14.0,
        medium: "wind_m_per_s = 0.0\n[medium.surface]\nroughness_m = 0.05\nslope_deg = 3.0\n[medium.multipath]\nlegs = \"surface\"",
        scene: &plane(BOTTOM_M, "density_per_m2 = 400.0"),
        model: DIRECT,
        patterns: OMNI,
        speed: 0.0,
    };
    let spec = rig(folder.path(), &setup);
    pool(2).expect("threads").install(|| {
        pings(&spec, 1, |_, _, scatterers| {
            let (mut sum_m, mut count, mut aside2) = (0.0, 0.0, 0.0);
            for i in scatterers.of_scene()..scatterers.len() {
                let (out_m, back_m) = (scatterers.transmit_m(i), scatterers.position_m(i));
                // D and S of the ground within 1.5 m of the sonar.
                let beside_m = out_m.truncate().length();
                if (out_m.z - BOTTOM_M).abs() > 1e-6 || back_m.z > 0.0 || beside_m > 1.5 {
                    continue;
                }
                let sonar_m = DVec3::new(0.0, 0.0, SONAR_M);
                let image_m = out_m.with_z(-out_m.z);
                sum_m += back_m.distance(sonar_m) - image_m.distance(sonar_m);
                let ray = (back_m - sonar_m).normalize();
                aside2 += ray.angle_between(image_m - sonar_m).powi(2);
                count += 1.0;
            }
            let (r1, r2) = (SONAR_M, BOTTOM_M);
            let s2 = slope.tan().powi(2);
            // rho = 2 s r1 r2 / L lengthens the path by rho^2 L / (2 r1 r2).
            let want_m = 2.0 * s2 * r1 * r2 / (r1 + r2);
            let want_rad = 2.0 * s2.sqrt() * r2 / (r1 + r2);
            let (got_m, got_rad) = (sum_m / count, f64::sqrt(aside2 / count));
            println!("{count} echoes: {got_m:.5} m longer, predicted {want_m:.5}; {got_rad:.4} rad aside, predicted {want_rad:.4}");
            assert!(count > 2000.0);
            assert!((got_m / want_m - 1.0).abs() < 0.08, "{got_m} {want_m}");
            assert!((got_rad / want_rad - 1.0).abs() < 0.05, "{got_rad} {want_rad}");
        });
    });
}

/// The bits of a ping do not depend on threads or on the pings before it.
#[test]
fn reflected_echoes_have_the_same_bits_for_any_threads_and_history() {
    let folder = tempfile::tempdir().expect("a folder");
    let setup = Setup {
        khz: 100.0,
        range_m: 25.0,
        medium: "wind_m_per_s = 5.0\n[medium.surface]\nscattering = true\n[medium.multipath]",
        scene: &plane(8.0, "density_per_m2 = 4.0\nbottom = \"sand\""),
        model: DIRECT,
        patterns: OMNI,
        speed: 2.0,
    };
    let spec = rig(folder.path(), &setup);
    let with = |threads: usize, skip: u32| {
        pool(threads).expect("threads").install(|| {
            let mut recorded = RecordedRig::open(&spec).expect("opens");
            let mut slot = recorded.rig.slot(0);
            for ping in 1..=3 {
                let (sonar, order) = recorded.next_order(3).expect("an order");
                assert!(recorded.settle(sonar, &order));
                if ping > skip {
                    let (mode, utc) = (spec.nav.mode, order.transmit_utc);
                    make_ping(&mut recorded.rig, sonar, &order, mode, utc, &mut slot)
                        .expect("a ping");
                }
            }
            (slot.output.elements.clone(), slot.output.scene)
        })
    };
    let (one, scene) = with(1, 0);
    assert!(scene.images > 1000 && scene.surface > 1000, "{scene:?}");
    for (threads, skip) in [(2, 0), (7, 0), (2, 2)] {
        let (other, counts) = with(threads, skip);
        assert!(one == other, "{threads} threads, {skip} pings skipped");
        assert_eq!(
            (scene.images, scene.surface),
            (counts.images, counts.surface)
        );
    }
    let level: f64 = one[0].iq.iter().map(|x| x.norm_sqr()).sum();
    assert!(level.is_finite() && level > 0.0);
}

/// A beam 2 degrees wide along the track, with a culling floor: the gathered scatterers hold the whole second echo of both orders of the legs, although the
/// rough surface sends sound from beside the beam into it. The levels are those of everything within range, behind the same floor.
#[test]
fn a_narrow_beam_behind_its_floor_hears_the_whole_second_echo() {
    const BOTTOM_M: f64 = 8.0;
    // The standard deviation of the difference is about 0.15 dB.
    const PINGS: u32 = 96;
    const FLOOR_DB: f64 = -20.0;
    let folder = tempfile::tempdir().expect("a folder");
    let level = |floor: &str, reversed: bool| {
        let model = format!("{DIRECT}\n{floor}");
        let setup = Setup {
            khz: 200.0,
            range_m: 18.0,
            medium: "wind_m_per_s = 0.0\n[medium.surface]\nroughness_m = 0.05\nslope_deg = 6.0\n[medium.multipath]\nbottom_slope_deg = 3.0",
            scene: &plane(BOTTOM_M, "density_per_m2 = 60.0"),
            model: &model,
            patterns: [
                "pattern = \"rectangle\"\nlength_m = 0.19\nwidth_m = 0.004",
                "yaw_deg = 90.0\nelement_pattern = \"rectangle\"\nelement_length_m = 0.004\nelement_width_m = 0.05",
            ],
            speed: 3.0,
        };
        let spec = rig(folder.path(), &setup);
        let first_m = 0.5 * (4.0 * BOTTOM_M - 2.0 * SONAR_M);
        let mut sums = Cells {
            first_m,
            cell_m: 0.05,
            carrier_hz: 200e3,
            sums: vec![Complex64::ZERO; 40],
        };
        let (mut sum, mut gathered) = (0.0, 0);
        gather_pings(&spec, PINGS, |plan, all| {
            gathered += all.of_scene();
            let second = only(all, |out_m, back_m| {
                let (direct_m, image_m) = match reversed {
                    true => (back_m, out_m),
                    false => (out_m, back_m),
                };
                (direct_m - BOTTOM_M).abs() < 1e-6 && image_m > 2.0 * BOTTOM_M
            });
            // The floor itself leaves out the same of both.
            let mut plan = plan.clone();
            plan.model.cull_db = Some(FLOOR_DB);
            sum += sums.of(&spec, &plan, &second).iter().sum::<f64>();
        });
        (sum, gathered)
    };
    let floor = format!("cull_db = {FLOOR_DB:.1}");
    for reversed in [false, true] {
        let ((want, all), (got, some)) = (level("", reversed), level(&floor, reversed));
        let off_db = 10.0 * (got / want).log10();
        println!("reversed {reversed}: {off_db:+.2} dB, with {some} of {all} scatterers");
        assert!(some < all * 2 / 3, "{some} of {all}");
        assert!(off_db.abs() < 0.5, "{off_db} dB");
    }
}

/// Over a seabed of automatic density, images are thinned: fewer of them make a second echo of the same level and statistics. Against a dense
/// seabed whose images are all kept.
#[test]
fn thinned_images_keep_level_and_statistics() {
    const BOTTOM_M: f64 = 8.0;
    const PINGS: u32 = 320;
    // The range resolution of the pulse, for which the density is.
    const CELL_M: f64 = 0.3;
    let folder = tempfile::tempdir().expect("a folder");
    let echoes = |density: &str| {
        let setup = Setup {
            khz: 200.0,
            range_m: 18.0,
            medium: "wind_m_per_s = 0.0\n[medium.surface]\nroughness_m = 0.05\nslope_deg = 3.0\n[medium.multipath]\nbottom_slope_deg = 2.0",
            scene: &plane(BOTTOM_M, density),
            model: DIRECT,
            patterns: [
                "pattern = \"rectangle\"\nlength_m = 0.19\nwidth_m = 0.004",
                "element_pattern = \"rectangle\"\nelement_length_m = 0.19\nelement_width_m = 0.004",
            ],
            speed: 3.0,
        };
        let spec = rig(folder.path(), &setup);
        let mut sums = Cells {
            first_m: 0.5 * (4.0 * BOTTOM_M - 2.0 * SONAR_M),
            cell_m: CELL_M,
            carrier_hz: 200e3,
            sums: vec![Complex64::ZERO; 10],
        };
        let (mut intensities, mut images, mut direct) = (Vec::new(), 0, 0);
        gather_pings(&spec, PINGS, |plan, all| {
            let second = only(all, |out_m, back_m| {
                (out_m - BOTTOM_M).abs() < 1e-6 && back_m > 2.0 * BOTTOM_M
            });
            images += second.len();
            direct += all.of_scene();
            intensities.push(sums.of(&spec, plan, &second));
        });
        (intensities, images as f64 / direct as f64)
    };
    let (want, all) = echoes("density_per_m2 = 60.0");
    let (got, some) = echoes("density = \"auto\"");
    let mean_of = |pings: &[Vec<f64>], cell: usize| {
        pings.iter().map(|cells| cells[cell]).sum::<f64>() / pings.len() as f64
    };
    let cells = 0..want[0].len();
    let total = |pings: &[Vec<f64>]| cells.clone().map(|k| mean_of(pings, k)).sum::<f64>();
    let off_db = 10.0 * (total(&got) / total(&want)).log10();
    let relative = |pings: &[Vec<f64>]| -> Vec<f64> {
        let of = |k: usize| {
            let mean = mean_of(pings, k);
            pings.iter().map(move |cells| cells[k] / mean)
        };
        cells.clone().flat_map(of).collect()
    };
    let kurtosis = |values: &[f64]| {
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        values.iter().map(|x| x * x).sum::<f64>() / n / (mean * mean)
    };
    let (own, dense) = (relative(&got), relative(&want));
    let (of_own, of_dense) = (kurtosis(&own), kurtosis(&dense));
    let sorted = [own, dense].map(|mut values| {
        values.sort_by(f64::total_cmp);
        values
    });
    // Against those of the whole second echo, in decibels.
    let quantiles = [0.25, 0.5, 0.9, 0.97].map(|q: f64| {
        let [own, dense] = [0, 1].map(|k| sorted[k][(q * sorted[k].len() as f64) as usize]);
        10.0 * (own / dense).log10()
    });
    println!(
        "{off_db:+.2} dB, quantiles {quantiles:+.2?} dB, kurtosis {of_own:.2} of {of_dense:.2}; {some:.2} images a scatterer of {all:.2}"
    );
    assert!(some < 0.85 * all, "{some} {all}");
    assert!(off_db.abs() < 0.5, "{off_db} dB");
    assert!(
        quantiles.iter().all(|off| off.abs() < 0.5),
        "{quantiles:?} dB"
    );
    // What the automatic density allows in a shadow.
    assert!(of_own < 2.6, "{of_own}");
}

/// Over a seabed of automatic density a surface with waves is thinned: fewer scatterers, the same level as the whole surface at rest.
#[test]
fn a_thinned_surface_keeps_its_level() {
    const PINGS: u32 = 60;
    let folder = tempfile::tempdir().expect("a folder");
    let level = |waves: bool| {
        let medium = format!(
            "wind_m_per_s = 8.0\n[medium.surface]\nscattering = true\nwaves = {waves}\ncorrelation_time_ms = 40.0"
        );
        let setup = Setup {
            khz: 200.0,
            range_m: 16.0,
            medium: &medium,
            scene: &plane(8.0, "density = \"auto\""),
            model: DIRECT,
            patterns: [
                "roll_deg = 90.0\npattern = \"rectangle\"\nlength_m = 0.19\nwidth_m = 0.004",
                "roll_deg = 90.0\nelement_pattern = \"rectangle\"\nelement_length_m = 0.19\nelement_width_m = 0.004",
            ],
            speed: 3.0,
        };
        let spec = rig(folder.path(), &setup);
        let mut sums = Cells {
            first_m: SONAR_M,
            cell_m: 0.3,
            carrier_hz: 200e3,
            sums: vec![Complex64::ZERO; 44],
        };
        let (mut sum, mut count) = ([0.0; 2], 0);
        gather_pings(&spec, PINGS, |plan, all| {
            let mut surface = Scatterers {
                moving: all.moving.clone(),
                ..Scatterers::default()
            };
            for i in all.of_scene()..all.len() {
                surface.push_copy(all, i, 1.0);
            }
            count += surface.len() + surface.moving.len();
            // Before the bottom echo, and with it.
            let cells = sums.of(&spec, plan, &surface);
            sum[0] += cells[..19].iter().sum::<f64>();
            sum[1] += cells[19..].iter().sum::<f64>();
        });
        (sum, count)
    };
    let ((want, all), (got, some)) = (level(false), level(true));
    let off_db = [0, 1].map(|k| 10.0 * (got[k] / want[k]).log10());
    println!("{off_db:+.2?} dB, with {some} of {all} scatterers");
    assert!(some < all * 2 / 3, "{some} of {all}");
    assert!(off_db.iter().all(|off| off.abs() < 0.5), "{off_db:?} dB");
}

/// Over a sloping bottom the distance of an image is the length of the shortest path by bottom and surface (Fermat), found by moving both points of
/// reflection in turns.
#[test]
fn the_image_by_a_sloping_bottom_is_as_far_as_the_shortest_path() {
    let folder = tempfile::tempdir().expect("a folder");
    let (depth_m, north, east) = (9.0, -0.06, 0.12);
    let setup = Setup {
        khz: 100.0,
        range_m: 20.0,
        medium: "[medium.multipath]\nbottom_roughness_m = 0.0",
        scene: &plane(
            depth_m,
            &format!("slope_north = {north}\nslope_east = {east}\ndensity_per_m2 = 1.0"),
        ),
        model: DIRECT,
        patterns: OMNI,
        speed: 0.0,
    };
    let spec = rig(folder.path(), &setup);
    let up = DVec3::new(north, east, -1.0).normalize();
    let on_bottom = DVec3::new(0.0, 0.0, depth_m);
    let meet = |from_m: DVec3, to_m: DVec3, at_m: DVec3, normal: DVec3| {
        let image_m = to_m - 2.0 * (to_m - at_m).dot(normal) * normal;
        let ray_m = image_m - from_m;
        from_m + ray_m * ((at_m - from_m).dot(normal) / ray_m.dot(normal))
    };
    pool(2).expect("threads").install(|| {
        pings(&spec, 1, |_, _, scatterers| {
            let sonar_m = DVec3::new(0.0, 0.0, SONAR_M);
            let (mut count, mut worst_m) = (0, 0.0f64);
            for i in scatterers.of_scene()..scatterers.len() {
                let (at_m, image_m) = (scatterers.transmit_m(i), scatterers.position_m(i));
                let is_direct = (at_m - on_bottom).dot(up).abs() < 1e-4;
                if !is_direct || image_m.z < depth_m || image_m.distance(at_m) < 1.0 {
                    continue;
                }
                let mut surface_m = 0.5 * (sonar_m + at_m).with_z(0.0);
                let mut bottom_m = DVec3::ZERO;
                for _ in 0..400 {
                    bottom_m = meet(sonar_m, surface_m, on_bottom, up);
                    surface_m = meet(bottom_m, at_m, DVec3::ZERO, DVec3::Z);
                }
                let path_m = sonar_m.distance(bottom_m)
                    + bottom_m.distance(surface_m)
                    + surface_m.distance(at_m);
                worst_m = worst_m.max((path_m - image_m.distance(sonar_m)).abs());
                count += 1;
            }
            println!("{count} images, {worst_m:.1e} m");
            assert!(count > 100 && worst_m < 1e-4, "{count} {worst_m}");
        });
    });
}
