//! Volume reverberation of whole pings: level, statistics and covariance against integrals of the sonar equation.

use std::f64::consts::{PI, TAU};
use std::path::Path;

use num_complex::Complex64;

use echotank_config::spec::RigSpec;
use echotank_ping::make_ping;
use echotank_ping::threads::pool;
use echotank_runtime::config_files::parse;
use echotank_runtime::recorded::RecordedRig;

const C: f64 = 1500.0;
const CARRIER_HZ: f64 = 100e3;
const WAVELENGTH_M: f64 = C / CARRIER_HZ;
const RATE_HZ: f64 = 30e3;
const PULSE_S: f64 = 0.2e-3;
const ELEMENTS: usize = 24;
const SPACING_M: f64 = 0.5 * WAVELENGTH_M;
/// Width of the elements and of the transmitter, level, metres.
const WIDTHS_M: [f64; 2] = [0.05, 0.1];
const SONAR_M: f64 = 10.0;
const ABSORPTION_DB_PER_M: f64 = 0.04;
const SOURCE_DB: f64 = 210.0;
/// Layers: top and bottom, metres, and Sv, dB re 1/m.
const LAYERS: [(f64, f64, f64); 2] = [(0.0, 6.0, -75.0), (12.0, 30.0, -60.0)];
const GATE_M: (f64, f64) = (20.0, 36.0);

const PINGS: u32 = 60;

/// An upright line of elements that looks ahead, at rest.
fn config(folder: &Path, synthesis: &str) -> String {
    let track = folder.join("track.csv");
    let mut rows = "time_s,north_m,east_m,down_m,roll_deg,pitch_deg,heading_deg\n".to_owned();
    for k in 0..2 * PINGS {
        rows += &format!("{},0,0,0,0,0,0\n", f64::from(k) * 0.5);
    }
    std::fs::write(&track, rows).expect("a track");
    let layers = LAYERS.map(|(top, bottom, sv)| {
        format!("[[medium.volume]]\ntop_m = {top}\nbottom_m = {bottom}\nsv_db = {sv}\n")
    });
    format!(
        r#"
[medium]
sound_speed_m_per_s = {C}
absorption = {{ db_per_km = {} }}
{}
[nav]
origin = {{ latitude_deg = 54.3, longitude_deg = 10.2 }}
mode = "settle"
vertical = "depth"
[[nav.source]]
name = "track"
kind = "csv"
path = "{}"
[scene]
seed = 5
[[sonar]]
name = "line"
[sonar.pulse]
kind = "cw"
center_frequency_khz = 100.0
duration_ms = 0.2
taper = 0.0
[[sonar.transmit]]
name = "tx"
position_m = [0.0, 0.0, {SONAR_M}]
pitch_deg = 90.0
pattern = "rectangle"
length_m = {SPACING_M}
width_m = {}
baffled = true
[[sonar.receive]]
name = "rx"
elements = {ELEMENTS}
spacing_m = {SPACING_M}
position_m = [0.0, 0.0, {SONAR_M}]
pitch_deg = 90.0
element_pattern = "rectangle"
element_length_m = {SPACING_M}
element_width_m = {}
sensitivity_db = 0.0
[sonar.receiver]
sample_rate_khz = 30.0
rx_filter = "none"
noise_db = "none"
tvg = "none"
[sonar.ping]
range_m = 40.0
rate_hz = 2.0
source_level_db = {SOURCE_DB}
[sonar.model]
path = "stop-and-hop"
doppler = "none"
synthesis = "{synthesis}"
"#,
        ABSORPTION_DB_PER_M * 1e3,
        layers.join(""),
        track.display(),
        WIDTHS_M[1],
        WIDTHS_M[0],
    )
}

fn sinc(x: f64) -> f64 {
    if x == 0.0 {
        1.0
    } else {
        (PI * x).sin() / (PI * x)
    }
}

/// Two-way power towards a direction: u up along the line, v level across it, ahead.
fn two_way(u: f64, v: f64) -> f64 {
    let line = |side_m: f64, sine: f64| sinc(side_m / WAVELENGTH_M * sine);
    let amplitude =
        line(SPACING_M, u).powi(2) * WIDTHS_M.map(|w| line(w, v)).iter().product::<f64>();
    amplitude * amplitude
}

fn scattered_per_m3(down_m: f64) -> f64 {
    let inside = LAYERS.iter().filter(|l| (l.0..l.1).contains(&down_m));
    inside.map(|l| 10f64.powf(l.2 / 10.0)).sum()
}

/// Covariances E[x_a conj(x_b)] of elements `k` apart (a above b) without spreading, absorption and source level, at a range: the integral of Sv b b' exp(j k
/// (z_a - z_b) u) over directions, times the common part of both pulses, times c/2.
fn covariances(range_m: f64) -> Vec<Complex64> {
    const SINES: usize = 1600;
    const ANGLES: usize = 600;
    let mut sums = vec![Complex64::ZERO; ELEMENTS];
    for i in 0..SINES {
        let u = -1.0 + (i as f64 + 0.5) * 2.0 / SINES as f64;
        let scattered = scattered_per_m3(SONAR_M - u * range_m);
        if scattered == 0.0 {
            continue;
        }
        let beside = (1.0 - u * u).sqrt();
        let around: f64 = (0..ANGLES)
            .map(|m| {
                let phi = -0.5 * PI + (m as f64 + 0.5) * PI / ANGLES as f64;
                two_way(u, beside * phi.sin()) * PI / ANGLES as f64
            })
            .sum();
        let power = scattered * around * 2.0 / SINES as f64;
        for (k, sum) in sums.iter_mut().enumerate() {
            // The upper element is nearer to what lies above.
            let late_s = k as f64 * SPACING_M * u / C;
            let common_s = (PULSE_S - late_s.abs()).max(0.0);
            *sum += power * 0.5 * C * common_s * Complex64::cis(TAU * CARRIER_HZ * late_s);
        }
    }
    sums
}

/// Samples of all elements in the gate, without spreading, absorption and source level: ping, sample, element from the top.
struct Measured {
    samples: Vec<Vec<[Complex64; ELEMENTS]>>,
    ranges_m: Vec<f64>,
}

fn measure(spec: &RigSpec, threads: usize, pings: u32) -> Measured {
    pool(threads).expect("threads").install(|| {
        let mut recorded = RecordedRig::open(spec).expect("opens");
        let mut slot = recorded.rig.slot(0);
        let mut measured = Measured {
            samples: Vec::new(),
            ranges_m: Vec::new(),
        };
        for _ in 0..pings {
            let (sonar, order) = recorded.next_order(pings).expect("an order");
            assert!(recorded.settle(sonar, &order));
            let (mode, utc) = (spec.nav.mode, order.transmit_utc);
            make_ping(&mut recorded.rig, sonar, &order, mode, utc, &mut slot).expect("a ping");
            assert!(slot.output.scene.volume > 1000);
            let first_s = slot.plan.first_sample_s;
            // Echoes of a range lie in the middle of their pulse.
            let range = |k: usize| 0.5 * C * (first_s + k as f64 / RATE_HZ - 0.5 * PULSE_S);
            let frame = &slot.output.elements[0];
            let in_gate = (0..frame.samples).filter(|k| (GATE_M.0..GATE_M.1).contains(&range(*k)));
            let in_gate: Vec<usize> = in_gate.collect();
            measured.ranges_m = in_gate.iter().map(|k| range(*k)).collect();
            let rows = in_gate.iter().map(|&k| {
                let r = range(k);
                let loss = 10f64.powf((SOURCE_DB - 2.0 * ABSORPTION_DB_PER_M * r) / 20.0) / (r * r);
                // x points up: the last element is the highest. The volume grows with r^2.
                std::array::from_fn(|e| frame.element(ELEMENTS - 1 - e)[k] / (loss * r))
            });
            measured.samples.push(rows.collect());
        }
        measured
    })
}

/// Kolmogorov's probability of a distance D or more between n values and the exponential distribution.
fn exponential_p(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len() as f64;
    let mut d = 0.0_f64;
    for (k, x) in values.iter().enumerate() {
        let f = 1.0 - (-x).exp();
        d = d
            .max((f - k as f64 / n).abs())
            .max(((k + 1) as f64 / n - f).abs());
    }
    let x = (n.sqrt() + 0.12 + 0.11 / n.sqrt()) * d;
    let terms = (1..100).map(|j: i32| {
        let sign = if j % 2 == 1 { 2.0 } else { -2.0 };
        sign * (-2.0 * f64::from(j * j) * x * x).exp()
    });
    terms.sum::<f64>().clamp(0.0, 1.0)
}

/// With four scatterers a cell, and with sixteen, whose envelope more samples do not tell from Rayleigh's.
#[test]
fn level_covariance_and_statistics_are_those_of_the_integral() {
    for (per_cell, apart) in [(4, 27), (16, 12)] {
        check_statistics(per_cell, apart);
    }
}

/// Compares pings with the integral. Samples `apart` from each other are taken as independent: a pulse has 6, and the sound passes the array in 4.
fn check_statistics(per_cell: u32, apart: usize) {
    println!("{per_cell} scatterers a cell:");
    let folder = tempfile::tempdir().expect("a folder");
    let text = config(folder.path(), "direct");
    let of_medium = format!("[medium]\nvolume_scatterers_per_cell = {per_cell}");
    let text = text.replace("[medium]", &of_medium);
    let spec = parse(&text, folder.path()).unwrap_or_else(|why| panic!("{why}"));
    let measured = measure(&spec, 2, PINGS);
    let ranges_m = &measured.ranges_m;
    let all: Vec<Vec<Complex64>> = ranges_m.iter().map(|r| covariances(*r)).collect();

    // Level of an element, and covariance of elements, over the whole gate.
    let want: Vec<Complex64> = (0..ELEMENTS)
        .map(|k| all.iter().map(|c| c[k]).sum::<Complex64>() / all.len() as f64)
        .collect();
    let mut got = vec![Complex64::ZERO; ELEMENTS];
    for row in measured.samples.iter().flatten() {
        for (k, got) in got.iter_mut().enumerate() {
            let pairs = ELEMENTS - k;
            let sum: Complex64 = (0..pairs).map(|e| row[e] * row[e + k].conj()).sum();
            *got += sum / (pairs * ranges_m.len()) as f64 / f64::from(PINGS);
        }
    }
    let level_db = 10.0 * (got[0].re / want[0].re).log10();
    println!("element level: {level_db:+.2} dB of the integral");
    assert!(level_db.abs() < 0.2, "{level_db} dB");
    let mut worst = 0.0_f64;
    for (got_k, want_k) in got.iter().zip(&want) {
        worst = worst.max((got_k / got[0].re - want_k / want[0].re).norm());
    }
    println!("covariance: off by at most {worst:.3} of the level");
    assert!(worst < 0.05, "{worst}");

    // Beams up and down, by phases: level against w' C w.
    for up in [-0.8, -0.5, -0.2, 0.15, 0.35] {
        let weights: [Complex64; ELEMENTS] = std::array::from_fn(|e| {
            let phase = TAU * CARRIER_HZ * e as f64 * SPACING_M * up / C;
            Complex64::cis(phase) / ELEMENTS as f64
        });
        let beam = |row: &[Complex64; ELEMENTS]| -> Complex64 {
            row.iter().zip(&weights).map(|(x, w)| x * w).sum()
        };
        let power_at = |c: &[Complex64]| {
            let mut sum = Complex64::ZERO;
            for (a, wa) in weights.iter().enumerate() {
                for (b, wb) in weights.iter().enumerate() {
                    let of = if b >= a { c[b - a] } else { c[a - b].conj() };
                    sum += wa * wb.conj() * of;
                }
            }
            sum.re
        };
        let want: Vec<f64> = all.iter().map(|c| power_at(c)).collect();
        let (mut got_sum, mut values) = (0.0, Vec::new());
        for ping in &measured.samples {
            for (k, row) in ping.iter().enumerate() {
                let power = beam(row).norm_sqr();
                got_sum += power;
                if k % apart == 0 {
                    values.push(power / want[k]);
                }
            }
        }
        let mean = got_sum / f64::from(PINGS) / want.iter().sum::<f64>();
        let level_db = 10.0 * mean.log10();
        let n = values.len();
        let kurtosis = values.iter().map(|x| x * x).sum::<f64>()
            / n as f64
            / (values.iter().sum::<f64>() / n as f64).powi(2);
        let p = exponential_p(values);
        println!(
            "beam at sine {up:+.2}: {level_db:+.2} dB of the integral, kurtosis {kurtosis:.2}, Kolmogorov-Smirnov p = {p:.2} of {n}"
        );
        assert!(level_db.abs() < 0.5, "{up}: {level_db} dB");
        assert!(p > 0.01, "{up}: p = {p}");
        // 2 for a Rayleigh envelope. Its sampling error is 0.1.
        assert!((kurtosis - 2.0).abs() < 0.3, "{up}: {kurtosis}");
    }

    // Pings are independent.
    let mut product = Complex64::ZERO;
    let mut power = 0.0;
    for pair in measured.samples.windows(2) {
        for (a, b) in pair[0].iter().zip(&pair[1]) {
            product += a[0] * b[0].conj();
            power += a[0].norm_sqr();
        }
    }
    let correlation = (product / power).norm();
    assert!(correlation < 0.06, "{correlation}");
}

#[test]
fn engines_and_threads_agree() {
    let folder = tempfile::tempdir().expect("a folder");
    let [exact, gridded] = ["direct", "gridded-1d"].map(|synthesis| {
        // Gridded engines take no pulse with sharp edges.
        let text = config(folder.path(), synthesis)
            .replace("taper = 0.0", "taper = 0.5")
            .replace("rx_filter = \"none\"", "rx_filter = \"fir\"");
        parse(&text, folder.path()).unwrap_or_else(|why| panic!("{why}"))
    });
    let one = measure(&exact, 1, 4);
    let three = measure(&exact, 3, 4);
    assert!(one.samples == three.samples);
    let other = measure(&gridded, 2, 4);
    let (mut off, mut all) = (0.0, 0.0);
    for (a, b) in one
        .samples
        .iter()
        .flatten()
        .zip(other.samples.iter().flatten())
    {
        off += a
            .iter()
            .zip(b)
            .map(|(a, b)| (a - b).norm_sqr())
            .sum::<f64>();
        all += a.iter().map(|a| a.norm_sqr()).sum::<f64>();
    }
    let error = (off / all).sqrt();
    assert!(error < 1e-3, "{error}");
}
