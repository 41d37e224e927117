//! Sweeps of one quantity each, and the text of their page.

use echotank_core::arrays::Pattern;
use echotank_core::navigation::NavQuantity;
use echotank_core::scene::ScatterLaw;
use glam::DVec3;

use super::spot::{Base, DOWN_M, Said, Spot, place, scatter};

/// Speed of 5 knots.
const CRUISE_M_PER_S: f64 = 2.572;

/// One sweep, shown as one map.
pub(crate) struct Regime {
    /// File name of the figure.
    pub(crate) name: &'static str,
    pub(crate) title: &'static str,
    /// Quantity of the columns, with its unit.
    pub(crate) axis: &'static str,
    pub(crate) values: &'static [f64],
    /// Values on both sides of the failure, for tests.
    #[cfg_attr(not(test), expect(dead_code, reason = "the columns of the short form"))]
    pub(crate) few: &'static [f64],
    pub(crate) spot: fn(&Base, f64) -> Spot,
    /// Sentence below the figure.
    pub(crate) says: &'static str,
    /// Behaviour of the formula of the paper.
    pub(crate) paper: &'static str,
    pub(crate) ours: &'static str,
}

impl Regime {
    /// Whether the error is in the navigation itself, which no method can detect.
    pub(crate) fn is_blind(&self) -> bool {
        self.name.starts_with("navigation")
    }

    /// Label of a column.
    pub(crate) fn label(&self, value: f64) -> String {
        if self.name == "navigation-faults" {
            return FAULTS[value as usize].to_owned();
        }
        match value {
            v if v == NO_FLOOR => "none".into(),
            0.0 => "0".into(),
            v if (1e-3..1e5).contains(&v.abs()) => format!("{v}"),
            v => format!("{v:.0e}"),
        }
    }
}

/// Value that means no culling.
const NO_FLOOR: f64 = -999.0;

const FAULTS: [&str; 9] = [
    "as it is",
    "stamps repeated",
    "stamps backward",
    "a sentence lost",
    "jump of 5 cm",
    "jump of 500 m",
    "gap of 1 s",
    "gap of 6 s",
    "an hour ahead",
];

pub(crate) const ALL: [Regime; 20] = [
    Regime {
        name: "speed",
        title: "Speed of the platform, from rest to a tenth of the speed of sound",
        axis: "m/s along the track",
        values: &[
            0.0, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 0.5, 2.572, 5.144, 9.5, 12.0, 30.0,
            100.0, 149.0, 151.0,
        ],
        few: &[0.0, 1e-6, 2.572, 12.0, 149.0, 151.0],
        spot: |base, v| base.under_way(v).through_navigation(0.1, |_, _, _| {}),
        says: "Stop-and-hop is accurate only up to 10 micrometres per second. The paper's Eq. 21 is never better\n\
               than stop-and-hop. The gridded engines are built for 10 m/s and count faster echoes. Above 150 m/s\n\
               navigation rejects the positions and the ping is skipped.",
        paper: "divides by the speed (Eq. 5), and Eq. 21 reverses Eq. 5: from 0.1 m/s on the error is as large as the signal",
        ours: "one expression for every speed including 0; from 100 m/s on the engines count echoes outside their limits, and method selection reports the tolerance as not met; above 150 m/s: \"two positions imply 151 m/s\"",
    },
    Regime {
        name: "range",
        title: "Range of a scatterer, down to the transmitter itself",
        axis: "m from the transmitter",
        values: &[
            0.0, 1e-9, 1e-6, 1e-4, 1e-3, 3.75e-3, 1e-2, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0,
        ],
        few: &[0.0, 1e-6, 3e-3, 0.3, 30.0],
        spot: |base, r_m| {
            let mut spot = base.under_way(CRUISE_M_PER_S);
            spot.scatterers = scatter(&[DVec3::new(0.0, r_m, DOWN_M)]);
            spot.scatterers.strength[0] = 1.0.into();
            spot
        },
        says: "Nothing divides by zero at the transmitter. Within one wavelength the amplitude is that at one\n\
               wavelength, and the echo is counted (`too_close`).",
        paper: "1/r of both legs: infinite at the array",
        ours: "amplitude limited to that at one wavelength, and counted; error models include the larger effect of motion",
    },
    Regime {
        name: "grazing",
        title: "Incidence on a flat Lambert bottom, from nadir to grazing and beyond",
        axis: "degrees from the normal",
        values: &[
            0.0, 1.0, 10.0, 30.0, 60.0, 80.0, 85.0, 88.0, 89.0, 89.9, 89.99, 89.9999, 90.0, 91.0,
            120.0,
        ],
        few: &[0.0, 60.0, 89.9999, 90.0, 91.0],
        spot: |base, deg| {
            let mut spot = base.under_way(CRUISE_M_PER_S);
            let (sin, cos) = deg.to_radians().sin_cos();
            let points: Vec<DVec3> = (0..5)
                .map(|k| {
                    let range_m = 30.0 + 2.0 * f64::from(k);
                    DVec3::new(0.0, range_m * sin, DOWN_M + range_m * cos)
                })
                .collect();
            spot.scatterers = scatter(&points);
            spot.scatterers.law.fill(ScatterLaw::Lambert);
            spot
        },
        says: "No method fails between nadir and 90 degrees. Beyond 90 degrees the bottom returns no echo, in any\n\
               method and in the reference.",
        paper: "Eq. 13's 20 log cos is minus infinity dB at 90 degrees and undefined beyond",
        ours: "the cosine is limited to 0: no echo, for one leg or both",
    },
    Regime {
        name: "endfire",
        title: "Direction of the echo, from along the line of elements to broadside",
        axis: "degrees from the line, at 5 knots along it",
        values: &[
            0.0, 0.01, 0.1, 1.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 75.0, 85.0, 89.0, 90.0, 135.0,
            180.0,
        ],
        few: &[0.0, 45.0, 90.0, 180.0],
        spot: |base, deg| {
            let mut spot = base.under_way(CRUISE_M_PER_S);
            let points: Vec<DVec3> = (0..4)
                .map(|k| place(30.0 + 2.0 * f64::from(k), deg, 0.0))
                .collect();
            spot.scatterers = scatter(&points);
            spot
        },
        says: "At endfire the Doppler is strongest and the path is straight, so a time stretch suffices up to 30\n\
               degrees. Closer to broadside the path is curved, and a stretch does not model curvature.",
        paper: "worst ahead and astern; at 90 degrees as good as stop-and-hop",
        ours: "`stretch-quadratic` keeps the tolerance in every direction",
    },
    Regime {
        name: "elements",
        title: "Spacing of the elements: grating lobes, and lines too long for a far field",
        axis: "wavelengths from element to element",
        values: &[
            1e-3, 0.01, 0.1, 0.25, 0.5, 0.51, 0.75, 1.0, 1.5, 2.0, 5.0, 10.0, 30.0, 100.0, 300.0,
        ],
        few: &[0.5, 100.0],
        spot: |base, wavelengths| {
            let mut spot = base.under_way(CRUISE_M_PER_S);
            spot.spec.receive[0].spacing_m = wavelengths * base.wavelength_m();
            spot
        },
        says: "Grating lobes affect beams and not element samples. No method depends on the spacing, from a\n\
               thousandth of a wavelength to 300 wavelengths.",
        paper: "a plane wave over the subarray: fails as L^2/(8 r) grows beyond a wavelength",
        ours: "exact per element; `gridded-2d` divides the line into short sections as needed, or refuses",
    },
    Regime {
        name: "window-end",
        title: "An echo at the end of the listening window",
        axis: "pulse lengths from the echo's leading edge to the window's end",
        values: &[
            2.0, 1.5, 1.1, 1.01, 1.0, 0.99, 0.9, 0.5, 0.1, 0.01, 1e-3, 0.0, -0.01, -0.1, -0.5, -2.0,
        ],
        few: &[1.5, 1.0, 0.5, 1e-3, 0.0, -0.5],
        spot: |base, pulses| {
            let mut spot = base.spot();
            let window_s = echotank_ping::window_s(&spot.spec.settings, super::spot::C);
            let edge_s = window_s - pulses * spot.spec.pulse.duration_s;
            let far_m = 0.5 * super::spot::C * edge_s;
            spot.scatterers = scatter(&[place(30.0, 90.0, 0.0), place(far_m, 90.0, 0.0)]);
            // The echo at the end of the window has the same strength as the other echo.
            spot
        },
        says: "An echo at the end of the window is truncated and does not wrap around. Every method that keeps the\n\
               tolerance elsewhere keeps it here.",
        paper: "Eq. 18 on a grid of the window's length wraps the rest of the echo to the window's start",
        ours: "`spectral` pads for a pulse and the filter's tails; the engines' grids extend beyond the window",
    },
    Regime {
        name: "window-start",
        title: "An echo at the start of a window that opens late",
        axis: "pulse lengths from the window's start to the echo's leading edge",
        values: &[
            -2.0, -1.1, -1.01, -1.0, -0.99, -0.9, -0.5, -0.1, -0.01, 0.0, 0.01, 0.1, 0.5, 1.0, 2.0,
        ],
        few: &[-1.5, -1.0, -0.5, 0.0, 1.0],
        spot: |base, pulses| {
            let mut spot = base.spot();
            spot.first_sample_s = 0.03;
            let edge_s = spot.first_sample_s + pulses * spot.spec.pulse.duration_s;
            let near_m = 0.5 * super::spot::C * edge_s;
            spot.scatterers = scatter(&[place(near_m, 90.0, 0.0), place(40.0, 90.0, 0.0)]);
            spot
        },
        says: "Every method includes the rest of an echo that begins before the window opens.",
        paper: "the window begins with the pulse",
        ours: "as at the end",
    },
    Regime {
        name: "segments",
        title: "Length of the polyline's segments, on a platform that rolls by 5 degrees in a swell",
        axis: "ms; the window is 65 ms",
        values: &[
            0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 65.0, 100.0, 1000.0,
        ],
        few: &[0.5, 10.0, 1000.0],
        spot: |base, ms| {
            let mut spot = base.under_way(CRUISE_M_PER_S);
            (spot.motion.heave_m, spot.motion.roll_deg) = (0.5, 5.0);
            spot.spec.receive[0].mounting.position_m = DVec3::new(2.0, 1.0, 2.0);
            spot.spec.model.segment_s = ms * 1e-3;
            spot
        },
        says: "Constant attitude in each segment moves an off-centre element in steps. Chords of each element\n\
               (`k-segment`) keep 1e-3 here up to 5 ms. Echoes after the last segment extrapolate it.",
        paper: "ends at its last segment, and attitude changes in steps: \"the attitude change only occurs at the polyline intersection\"",
        ours: "`polyline` as printed, with its steps counted; `k-segment` and `continuous` as alternatives",
    },
    Regime {
        name: "manoeuvre",
        title: "Manoeuvres within a ping: roll of arrays on an arm of 3 m",
        axis: "degrees of roll, 5 s period",
        values: &[
            0.0, 1e-4, 1e-3, 0.01, 0.1, 0.3, 1.0, 3.0, 5.0, 10.0, 20.0, 40.0, 80.0,
        ],
        few: &[0.0, 1e-3, 1.0, 20.0, 80.0],
        spot: |base, deg| {
            let mut spot = base.under_way(CRUISE_M_PER_S);
            spot.motion.roll_deg = deg;
            spot.spec.receive[0].mounting.position_m = DVec3::new(2.0, 1.0, 2.0);
            spot.spec.transmit[0].mounting.position_m = DVec3::new(2.0, 1.0, 2.1);
            spot
        },
        says: "Path models fail one after another as roll increases. Echoes with accelerations above the limits of\n\
               the engines are counted.",
        paper: "its polyline changes the array's attitude in steps",
        ours: "`continuous` is limited by second-order Doppler; its error model gives the limit",
    },
    Regime {
        name: "attitude",
        title: "Pitch up to straight down and straight up, while the heading turns",
        axis: "degrees of pitch",
        values: &[
            -90.0, -89.999, -85.0, -45.0, 0.0, 45.0, 80.0, 89.0, 89.9, 89.999, 90.0,
        ],
        few: &[-90.0, 0.0, 89.999, 90.0],
        spot: |base, deg| {
            let mut spot = base.under_way(CRUISE_M_PER_S);
            spot.motion.pitch_deg = deg;
            spot.motion.heading_deg = 359.9;
            spot.motion.yaw_deg_per_s = 2.0;
            spot.through_navigation(0.02, |_, _, _| {})
        },
        says: "Attitude is a quaternion throughout. Gimbal lock at 90 degrees and a heading that passes 360 do not\n\
               affect models of continuous motion. The heading steps of a polyline matter except at vertical pitch.",
        paper: "Eq. 4 as printed is no rotation matrix (cos alpha instead of cos beta)",
        ours: "unit quaternions, interpolated along the shorter arc",
    },
    Regime {
        name: "navigation-rate",
        title: "Navigation rate, in a swell: samples compared with the true motion",
        axis: "s between two samples",
        values: &[
            0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 3.0, 4.9, 5.1, 6.0,
        ],
        few: &[0.02, 1.0, 6.0],
        spot: |base, every_s| {
            let mut spot = base.under_way(CRUISE_M_PER_S);
            (spot.motion.heave_m, spot.motion.roll_deg) = (0.5, 3.0);
            spot.through_navigation(every_s, |_, _, _| {})
        },
        says: "No method can recover motion that navigation does not report. At 20 Hz and above the samples match\n\
               the true swell within 1e-3 (`continuous`, `stretch-quadratic`). At lower rates they match the\n\
               interpolated curve. With intervals of 3 s and more the ten-second history of this sonar holds no\n\
               position before the ping, and the ping is skipped.",
        paper: "vertices of the polyline are the navigation's own samples, straight between them",
        ours: "a smooth curve through them, the same for every method; the remaining error is in the input",
    },
    Regime {
        name: "navigation-faults",
        title: "Navigation faults: repeated and backward timestamps, jumps, gaps, a fast clock",
        axis: "fault",
        values: &[0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0],
        few: &[0.0, 1.0, 2.0, 5.0, 8.0],
        spot: |base, which| {
            let spot = base.under_way(CRUISE_M_PER_S);
            let spoil = |k: usize, valid_s: f64, said: &mut Vec<Said>| match which as usize {
                1 if k % 2 == 1 => said.iter_mut().for_each(|s| s.valid_s -= 0.1),
                // Late messages that arrive after newer ones.
                2 if k % 3 == 2 => {
                    for s in said.iter_mut() {
                        s.valid_s -= 0.15;
                        if let NavQuantity::LocalPosition { north_m, .. } = &mut s.quantity {
                            *north_m -= 0.15 * CRUISE_M_PER_S;
                        }
                    }
                }
                3 if valid_s.abs() < 0.06 => said.clear(),
                4 | 5 if valid_s >= 0.02 => {
                    for s in said.iter_mut() {
                        if let NavQuantity::LocalPosition { east_m, .. } = &mut s.quantity {
                            *east_m += if which == 4.0 { 0.05 } else { 500.0 };
                        }
                    }
                }
                6 if (-0.5..0.5).contains(&valid_s) => said.clear(),
                7 if (-3.0..3.0).contains(&valid_s) => said.clear(),
                8 => said.iter_mut().for_each(|s| s.valid_s += 3600.0),
                _ => {}
            };
            spot.through_navigation(0.1, spoil)
        },
        says: "Navigation samples with repeated timestamps are dropped; late ones are inserted in order.\n\
               Interpolation bridges a gap of 1 s but not of 6 s. A jump that implies more than 150 m/s is\n\
               rejected, a smaller one accepted. With a clock one hour ahead the ping is skipped.",
        paper: "not considered",
        ours: "the navigation history counts each of these; rejections name the channel and the value",
    },
    Regime {
        name: "far-from-origin",
        title: "Distance from the world's origin: f32 would fail beyond 100 m",
        axis: "m north and east of the origin",
        values: &[0.0, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8],
        few: &[0.0, 1e6, 1e7],
        spot: |base, away_m| {
            let mut spot = base.under_way(CRUISE_M_PER_S);
            spot.offset_m = DVec3::new(away_m, away_m, 0.0);
            spot
        },
        says: "Positions are f64 and every ping is relative to its own transmitter. No error is measurable 10,000\n\
               km from the origin. In f32 the carrier phase would be lost at 10 km, where the resolution is 1 mm\n\
               and the wavelength 3.75 mm.",
        paper: "not stated; the numbers of its script are f64",
        ours: "f64 positions; phases are reduced before conversion to f32",
    },
    Regime {
        name: "frequency-step",
        title: "The frequency step of `spectral`, in parts of one over the record's length",
        axis: "step times record",
        values: &[
            0.25, 0.5, 0.8, 0.9, 0.95, 1.0, 1.05, 1.1, 1.25, 1.5, 2.0, 3.0, 4.0, 8.0,
        ],
        few: &[0.5, 2.0],
        spot: |base, share| {
            let mut spot = base.spot();
            let settings = &spot.spec.settings;
            let record_s = echotank_ping::window_s(settings, super::spot::C);
            spot.spec.synthesis.frequency_step_hz = Some(share / record_s);
            spot
        },
        says: "A step above one over the length of the record wraps late echoes around onto early ones. The echoes\n\
               here lie in the second half of the window, so errors begin slightly above 1. This explains \"a narrow\n\
               interval improves fidelity\".",
        paper: "the step is chosen by hand; a coarse step gives an error as large as the signal, without a warning",
        ours: "the default follows the record; an explicit step can fail, so it excludes `spectral` from method selection",
    },
    Regime {
        name: "pulse-stretch",
        title: "Doppler large against 1/T: the length of a wideband chirp at 10 knots",
        axis: "ms of pulse",
        values: &[0.2, 0.3, 0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0],
        few: &[0.3, 2.0],
        spot: |base, ms| {
            let mut spot = base.under_way(5.144);
            spot.spec.pulse.duration_s = ms * 1e-3;
            spot.spec.settings.pulse_duration_s = ms * 1e-3;
            spot.spec.limits.pulse_duration_s = (ms * 1e-3, ms * 1e-3);
            spot
        },
        says: "Without Doppler the phase drifts over a pulse of any practical length. A uniform stretch is accurate\n\
               up to pulses of 1 ms, above which the path is curved within the pulse. The second order is accurate\n\
               up to 20 ms; `gridded-1d` takes pulses up to 5 ms, `gridded-2d` up to 8 ms, `gridded-lines` all of these.",
        paper: "Eq. 21 shifts no frequency: it stretches the delays and not the pulse",
        ours: "every echo is stretched about its own arrival; the Doppler columns of the engines are designed for the longest pulse",
    },
    Regime {
        name: "sample-rate",
        title: "Sample rate against what band and Doppler need",
        axis: "sample rates over 1.25 (B + 2 f_d)",
        values: &[
            0.3, 0.5, 0.7, 0.8, 0.85, 0.9, 0.95, 1.0, 1.05, 1.1, 1.25, 1.5, 2.0, 3.0,
        ],
        few: &[0.5, 1.1],
        spot: |base, share| {
            let mut spot = base.under_way(CRUISE_M_PER_S);
            let pulse = &spot.spec.pulse;
            let highest_hz = pulse.center_frequency_hz + 0.5 * pulse.bandwidth_hz;
            let doppler_hz = 2.0 * 10.0 / super::spot::C * highest_hz;
            let needed_hz = 1.25 * (pulse.bandwidth_hz + 2.0 * doppler_hz);
            spot.spec.receiver.sample_rate_hz = share * needed_hz;
            spot
        },
        says: "If the pass band of the receiver filter does not fit the sample rate, the configuration is refused.\n\
               The message gives the smallest sufficient rate.",
        paper: "the band is sampled without a check",
        ours: "refused at start, with the required rate",
    },
    Regime {
        name: "tolerance",
        title: "The requested tolerance, 5 knots: colour is error over that tolerance",
        axis: "tolerance",
        values: &[
            1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9,
        ],
        few: &[1e-1, 1e-9],
        spot: |base, tolerance| {
            let mut spot = base.under_way(CRUISE_M_PER_S);
            spot.spec.synthesis.tolerance = tolerance;
            spot
        },
        says: "Each method has its own limit. Engines refuse tolerances that they cannot keep; for the other\n\
               methods error models predict the error. Below all limits, method selection reports that no method\n\
               keeps the tolerance.",
        paper: "no tolerance exists",
        ours: "an error bound, or a refusal with the value",
    },
    Regime {
        name: "culling",
        title: "Culling by beam patterns, up to everything",
        axis: "dB of the two-way pattern below which scatterers are left out",
        values: &[
            NO_FLOOR, -120.0, -100.0, -80.0, -60.0, -50.0, -40.0, -30.0, -20.0, -10.0, -6.0, -3.0,
            -1.0,
        ],
        few: &[NO_FLOOR, -80.0, -3.0],
        spot: |base, floor_db| {
            let mut spot = base.spot();
            let pattern = Pattern::Rectangle {
                length_m: 0.1,
                width_m: 0.0,
                baffled: false,
            };
            spot.spec.transmit[0].pattern = pattern;
            spot.spec.receive[0].element_pattern = pattern;
            spot.spec.model.cull_db = (floor_db != NO_FLOOR).then_some(floor_db);
            // A swath of flat bottom, a few degrees of which are inside the beam.
            let points: Vec<DVec3> = (0..48)
                .map(|k| place(30.0 + 0.2 * f64::from(k % 12), 66.5 + f64::from(k), 12.0))
                .collect();
            spot.scatterers = scatter(&points);
            spot.scatterers.law.fill(ScatterLaw::Lambert);
            spot
        },
        says: "The error of a culling floor is the energy that it removes from a flat bottom. The error models give\n\
               an upper bound. Method selection lowers the floor until the tolerance is kept, and never raises it.",
        paper: "keeps every scatterer",
        ours: "the culled share of energy is part of the predicted error",
    },
    Regime {
        name: "scatterers",
        title: "Empty scenes, single points, coincident points",
        axis: "scatterers (those above 100: that many less 100, all in one place)",
        values: &[0.0, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 101.0, 102.0, 110.0],
        few: &[0.0, 1.0, 110.0],
        spot: |base, count| {
            let mut spot = base.under_way(CRUISE_M_PER_S);
            let points: Vec<DVec3> = match count > 100.0 {
                true => (100..count as usize)
                    .map(|_| place(33.0, 80.0, 12.0))
                    .collect(),
                false => (0..count as usize)
                    .map(|k| place(30.0 + 0.45 * k as f64, 60.0 + 3.0 * k as f64, 12.0))
                    .collect(),
            };
            spot.scatterers = scatter(&points);
            spot
        },
        says: "An empty scene and a scene entirely in shadow give no signal. A single point and many coincident\n\
               points need no special case.",
        paper: "its curvature and incidence energies (Eqs. 27 and 28) divide by the maximum: 0/0 for a single point",
        ours: "exactly zero samples",
    },
    Regime {
        name: "grid-edge",
        title: "An echo at fractional positions of the engines' grid",
        axis: "samples",
        values: &[
            0.0, 0.01, 0.05, 0.1, 0.2, 0.25, 0.3, 0.4, 0.49, 0.5, 0.51, 0.75, 0.9, 0.99, 1.0,
        ],
        few: &[0.0, 0.5, 0.99],
        spot: |base, samples| {
            let mut spot = base.spot();
            // The two-way delay is a whole number of samples plus `samples`.
            let rate_hz = spot.rate_hz();
            let delay_s = ((0.041 * rate_hz).round() + samples) / rate_hz;
            let points = [DVec3::new(0.0, 0.5 * super::spot::C * delay_s, DOWN_M)];
            spot.scatterers = scatter(&points);
            spot
        },
        says: "The kernel of the engines is as accurate between grid points as on them. `nearest` and `linear`\n\
               exceed the tolerance everywhere, and most half way between two samples.",
        paper: "Eq. 18 has no grid of delays",
        ours: "kernel width follows the tolerance",
    },
];
