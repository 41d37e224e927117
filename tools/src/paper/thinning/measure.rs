//! Scene, sonar, simplifiers and image metrics. Used by `tools/paper 12` and by its short form in the tests.

use std::time::Instant;

use echotank_config::spec::{LineSpec, PaperShape};
use echotank_core::arrays::{ArrayGeometry, Mounting, Pattern, TransmitArray};
use echotank_core::ping::{ElementFrame, Line, PingPlan, Side};
use echotank_core::pulse::{Pulse, PulseKind};
use echotank_core::scene::Scatterers;
use echotank_core::settings::SonarSettings;
use echotank_imaging::beam::RowLimits;
use echotank_imaging::beam::sidescan::LineFormer;
use echotank_scene::paper::{self, Cloud};
use echotank_scene::simplify::collapse::{Collapsed, collapse};
use echotank_scene::simplify::energy::{Beam, Energies, View};
use echotank_scene::simplify::shadow::Horizon;
use echotank_scene::simplify::{Method, Selection, Settings, Weights};
use echotank_synthesis::array::Direct;
use echotank_synthesis::echo::{TransmitLeg, Window, Workspace, arrivals, insonify};
use echotank_testing::echo as rig;
use glam::{DQuat, DVec3};
use num_complex::Complex64;
use rayon::prelude::*;

pub(crate) const POINT_COUNTS: [usize; 4] = [5125, 3000, 1000, 176];

const SOUND_SPEED_M_PER_S: f64 = 1500.0;
const CARRIER_HZ: f64 = 400e3;
const WAVELENGTH_M: f64 = SOUND_SPEED_M_PER_S / CARRIER_HZ;
const SAMPLE_RATE_HZ: f64 = 40e3;
/// Aperture, metres: 0.886 lambda / 0.56 degrees.
const APERTURE_M: f64 = 0.34;
const ABSORPTION_DB_PER_M: f64 = 0.096;
const LAMBERT_DB: f64 = -20.0;
const PING_SPACING_M: f64 = 0.25;
/// Speed, 3 knots.
const SPEED_M_PER_S: f64 = 1.543;
const TRACK_MIDDLE_NORTH_M: f64 = 10.0;
const FIRST_SAMPLE_S: f64 = 0.044;
/// Number of samples, for slant ranges up to 82 m plus the pulse.
const SAMPLES: usize = 2830;
/// Slant ranges of the image, metres.
const IMAGE_M: (f64, f64) = (34.0, 80.0);
const BLOCK_PINGS: usize = 4;
const BLOCK_SAMPLES: usize = 64;
const CLIP_DB: f64 = 20.0;
/// Level relative to the median of the original below which a block is shadow, dB. Such blocks are not compared.
const SHADOW_DB: f64 = -30.0;
/// Difference between the half sizes of scene and track. The whole scene is within this distance of the middle of the track.
const PASS_SLACK_M: f64 = 12.0;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Simplifier {
    /// Quadric error. The area of removed vertices is lost.
    Conventional,
    /// Quadric error. Kept vertices inherit the area of removed vertices.
    ConventionalWithArea,
    Paper,
    /// Sum of energies of the paper, corrected.
    Acoustic,
    /// As `Acoustic`, with the product of scattering and axis.
    AcousticEcho,
    Unbiased,
}

impl Simplifier {
    pub(crate) const ALL: [Self; 6] = [
        Self::Conventional,
        Self::ConventionalWithArea,
        Self::Paper,
        Self::Acoustic,
        Self::AcousticEcho,
        Self::Unbiased,
    ];
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Conventional => "conventional",
            Self::ConventionalWithArea => "conventional, areas",
            Self::Paper => "paper",
            Self::Acoustic => "acoustic",
            Self::AcousticEcho => "acoustic, echo weight",
            Self::Unbiased => "acoustic-unbiased",
        }
    }
    /// Selection method and weights; `None` for edge collapse.
    fn rule(self) -> Option<(Method, Weights)> {
        match self {
            Self::Conventional | Self::ConventionalWithArea => None,
            Self::Paper => Some((Method::Paper, Weights::PAPER)),
            Self::Acoustic => Some((Method::Acoustic, Weights::PAPER)),
            Self::AcousticEcho => Some((Method::Acoustic, Weights::ECHO)),
            Self::Unbiased => Some((Method::Unbiased, Weights::ECHO)),
        }
    }
}

/// Time at which the selection is made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SelectionTime {
    EachPing,
    Pass,
}

impl SelectionTime {
    pub(crate) const ALL: [Self; 2] = [Self::EachPing, Self::Pass];
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::EachPing => "each ping",
            Self::Pass => "once",
        }
    }
}

/// Results in one row of the table.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Figures {
    pub(crate) points: usize,
    pub(crate) once: SelectionTime,
    pub(crate) simplifier: Simplifier,
    /// Mean number of kept scatterers.
    pub(crate) kept: f64,
    pub(crate) level_db: f64,
    /// Standard deviation of the level between seeds.
    pub(crate) level_scatter_db: f64,
    pub(crate) image_db: f64,
    pub(crate) l2: f64,
}

impl Figures {
    pub(crate) fn json(&self) -> serde_json::Value {
        serde_json::json!({
            "points": self.points,
            "chosen": self.once.name(),
            "simplifier": self.simplifier.name(),
            "kept": self.kept,
            "level_db": self.level_db,
            "level_scatter_db": self.level_scatter_db,
            "image_db": self.image_db,
            "l2": self.l2,
        })
    }
}

/// Element samples and image of one pass.
#[derive(Clone, Default)]
pub(crate) struct Pass {
    pub(crate) iq: Vec<Vec<Complex64>>,
    /// Energy of the line with gain, by ping and image sample.
    pub(crate) energy: Vec<Vec<f64>>,
}

/// Geometry that all seeds share.
pub(crate) struct Thinning {
    pings: usize,
    /// Scatterers in shadow, by ping.
    hidden: Vec<Vec<bool>>,
    curvatures: Energies,
    collapsed: Vec<Collapsed>,
}

/// Seed of positions. Seeds of speckle and of permanent random numbers count from 0.
const PLACES: u64 = 1;

impl Thinning {
    pub(crate) fn new(pings: usize) -> Self {
        let cloud = cloud(0);
        let s = &cloud.scatterers;
        let hidden = (0..pings)
            .into_par_iter()
            .map(|ping| {
                let mut hidden = vec![false; s.len()];
                Horizon::default().hide(s, s.len(), sonar_m(ping, pings), None, &mut hidden);
                hidden
            })
            .collect();
        let places: Vec<DVec3> = (0..s.len()).map(|i| s.position_m(i)).collect();
        let collapsed = POINT_COUNTS
            .par_iter()
            .map(|keep| collapse(&places, &cloud.triangles, *keep))
            .collect();
        let mut curvatures = Energies::default();
        curvatures.curvatures.fit(s, s.len());
        Self {
            pings,
            hidden,
            curvatures,
            collapsed,
        }
    }

    /// Every row of the table, averaged over `seeds` scenes.
    pub(crate) fn measure(&self, seeds: u64) -> Vec<Figures> {
        let each: Vec<Vec<Sums>> = (0..seeds)
            .into_par_iter()
            .map(|seed| self.one_seed(seed))
            .collect();
        let mut figures = Vec::new();
        for (k, (points, once, simplifier)) in rows().into_iter().enumerate() {
            let sums: Vec<&Sums> = each.iter().map(|rows| &rows[k]).collect();
            figures.push(Sums::figures(&sums, points, once, simplifier));
        }
        figures
    }

    fn one_seed(&self, seed: u64) -> Vec<Sums> {
        let all = cloud(seed).scatterers;
        let mut imager = Imager::new();
        let original = self.pass(&mut imager, |ping, out| {
            self.visible(&all, ping, out);
        });
        let mut sums = vec![Sums::default(); rows().len()];
        for once in SelectionTime::ALL {
            for simplifier in Simplifier::ALL {
                let passes = self.simplified(&all, seed, once, simplifier, &mut imager);
                for (points, (pass, kept)) in POINT_COUNTS.iter().zip(passes) {
                    let place = rows()
                        .iter()
                        .position(|row| *row == (*points, once, simplifier));
                    if let Some(place) = place {
                        sums[place] = Sums::of(&original, &pass, kept);
                    }
                }
            }
        }
        sums
    }

    /// The pass of the original scene, for images.
    pub(crate) fn original(&self) -> Pass {
        let all = cloud(0).scatterers;
        self.pass(&mut Imager::new(), |ping, out| {
            self.visible(&all, ping, out)
        })
    }

    /// Passes of a simplifier at every level, with the mean number of kept scatterers.
    pub(crate) fn passes(&self, once: SelectionTime, simplifier: Simplifier) -> Vec<(Pass, f64)> {
        let all = cloud(0).scatterers;
        self.simplified(&all, 0, once, simplifier, &mut Imager::new())
    }

    fn visible(&self, all: &Scatterers, ping: usize, out: &mut Scatterers) {
        for i in 0..all.len() {
            if !self.hidden[ping][i] {
                push(out, all, i, 1.0);
            }
        }
    }

    fn pass(
        &self,
        imager: &mut Imager,
        mut scatterers: impl FnMut(usize, &mut Scatterers),
    ) -> Pass {
        let mut pass = Pass::default();
        let mut heard = Scatterers::default();
        for ping in 0..self.pings {
            heard.clear();
            scatterers(ping, &mut heard);
            imager.ping(sonar_m(ping, self.pings), &heard, &mut pass);
        }
        pass
    }

    fn simplified(
        &self,
        all: &Scatterers,
        seed: u64,
        once: SelectionTime,
        simplifier: Simplifier,
        imager: &mut Imager,
    ) -> Vec<(Pass, f64)> {
        let mut passes = vec![(Pass::default(), 0.0); POINT_COUNTS.len()];
        let mut heard = Scatterers::default();
        let mut chooser = Chooser::new(self);
        for ping in 0..self.pings {
            for (size, keep) in POINT_COUNTS.into_iter().enumerate() {
                heard.clear();
                match simplifier.rule() {
                    None => {
                        let collapsed = &self.collapsed[size];
                        for (&i, share) in collapsed.kept.iter().zip(&collapsed.area_share) {
                            let inherits = simplifier == Simplifier::ConventionalWithArea;
                            let gain = if inherits { share.sqrt() } else { 1.0 };
                            if !self.hidden[ping][i as usize] {
                                push(&mut heard, all, i as usize, gain);
                            }
                        }
                        passes[size].1 += collapsed.kept.len() as f64 / self.pings as f64;
                    }
                    Some((method, weights)) => {
                        let settings = Settings {
                            method,
                            keep,
                            weights,
                            seed,
                        };
                        let place = match once {
                            SelectionTime::EachPing => Some(ping),
                            SelectionTime::Pass => None,
                        };
                        let selection = chooser.choose(all, place, self.pings, size, &settings);
                        for (&i, gain) in selection.kept.iter().zip(&selection.gain) {
                            if !self.hidden[ping][i as usize] {
                                push(&mut heard, all, i as usize, *gain);
                            }
                        }
                        passes[size].1 += selection.kept.len() as f64 / self.pings as f64;
                    }
                }
                imager.ping(sonar_m(ping, self.pings), &heard, &mut passes[size].0);
            }
        }
        passes
    }

    /// Milliseconds to select and to compute one ping (medians over the pings, this thread), and the level, dB. Without a
    /// simplifier, those of the original.
    pub(crate) fn time(&self, which: Option<(Simplifier, usize)>) -> (f64, f64, f64) {
        let all = cloud(0).scatterers;
        let mut imager = Imager::new();
        let mut chooser = Chooser::new(self);
        let (mut choose_ms, mut ping_ms) = (Vec::new(), Vec::new());
        let (mut got, mut want) = (Pass::default(), Pass::default());
        let mut heard = Scatterers::default();
        for ping in 0..self.pings {
            let at_m = sonar_m(ping, self.pings);
            heard.clear();
            self.visible(&all, ping, &mut heard);
            imager.ping(at_m, &heard, &mut want);
            let began = Instant::now();
            if let Some((simplifier, keep)) = which {
                heard.clear();
                match simplifier.rule() {
                    None => {
                        let size = POINT_COUNTS.iter().position(|r| *r == keep).unwrap_or(0);
                        let kept = &self.collapsed[size];
                        for (&i, share) in kept.kept.iter().zip(&kept.area_share) {
                            let inherits = simplifier == Simplifier::ConventionalWithArea;
                            let gain = if inherits { share.sqrt() } else { 1.0 };
                            push(&mut heard, &all, i as usize, gain);
                        }
                    }
                    Some((method, weights)) => {
                        let settings = Settings {
                            method,
                            keep,
                            weights,
                            seed: 0,
                        };
                        chooser.forget();
                        let chosen = chooser.choose(&all, Some(ping), self.pings, 0, &settings);
                        chosen.gather(&all, &mut heard);
                    }
                }
            }
            choose_ms.push(began.elapsed().as_secs_f64() * 1e3);
            let began = Instant::now();
            imager.ping(at_m, &heard, &mut got);
            ping_ms.push(began.elapsed().as_secs_f64() * 1e3);
        }
        let energy = |pass: &Pass| pass.energy.iter().flatten().sum::<f64>();
        let level_db = 10.0 * (energy(&got) / energy(&want)).log10();
        (median(choose_ms), median(ping_ms), level_db)
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

pub(crate) fn rows() -> Vec<(usize, SelectionTime, Simplifier)> {
    let mut rows = Vec::new();
    for points in POINT_COUNTS {
        for once in SelectionTime::ALL {
            for simplifier in Simplifier::ALL {
                let collapses = simplifier.rule().is_none();
                if !(collapses && once == SelectionTime::EachPing) {
                    rows.push((points, once, simplifier));
                }
            }
        }
    }
    rows
}

fn cloud(seed: u64) -> Cloud {
    paper::cloud(PaperShape::Relief, PLACES, 1000 + seed, LAMBERT_DB)
}

fn push(out: &mut Scatterers, all: &Scatterers, i: usize, gain: f64) {
    out.push(
        all.position_m(i),
        all.normal[i],
        all.strength[i] * gain,
        all.law[i],
    );
}

fn sonar_m(ping: usize, pings: usize) -> DVec3 {
    let from_middle = ping as f64 - (pings as f64 - 1.0) / 2.0;
    DVec3::new(
        TRACK_MIDDLE_NORTH_M + from_middle * PING_SPACING_M,
        0.0,
        0.0,
    )
}

/// Array axes of a face that looks to starboard and 30 degrees down: x forward, z the boresight.
fn body_from_array() -> DQuat {
    DQuat::from_rotation_x(-60f64.to_radians())
}

fn view(at_m: DVec3, slack_m: f64) -> View {
    let wavelengths = APERTURE_M / WAVELENGTH_M;
    let turn = body_from_array();
    View {
        apex_m: at_m,
        beams: vec![Beam {
            along: turn * DVec3::X,
            across: turn * DVec3::Y,
            boresight: turn * DVec3::Z,
            lengths: [wavelengths; 2],
            widths: [0.0; 2],
            baffled: true,
        }],
        slack_m,
        slack_rad: 0.0,
        shadows: true,
    }
}

/// Selector of scatterers. It keeps the energies while position and method stay the same.
struct Chooser {
    energies: Energies,
    selections: Vec<Selection>,
    made: Option<(Option<usize>, Method, Weights)>,
    /// Levels whose selection is fixed for the pass.
    chosen: Vec<bool>,
}

impl Chooser {
    fn new(thinning: &Thinning) -> Self {
        let mut energies = Energies::default();
        energies
            .curvatures
            .clone_values(&thinning.curvatures.curvatures);
        Self {
            energies,
            selections: POINT_COUNTS.iter().map(|_| Selection::default()).collect(),
            made: None,
            chosen: vec![false; POINT_COUNTS.len()],
        }
    }

    fn forget(&mut self) {
        self.made = None;
    }

    /// Selects scatterers for `ping`. `None` selects once, from the middle of the pass.
    fn choose(
        &mut self,
        all: &Scatterers,
        ping: Option<usize>,
        pings: usize,
        size: usize,
        settings: &Settings,
    ) -> &Selection {
        let key = (ping, settings.method, settings.weights);
        if self.made != Some(key) {
            let view = match ping {
                Some(ping) => view(sonar_m(ping, pings), 0.0),
                None => view(DVec3::X * TRACK_MIDDLE_NORTH_M, PASS_SLACK_M),
            };
            self.energies
                .evaluate_with_curvatures(all, all.len(), &view, settings, None);
            self.made = Some(key);
            self.chosen.fill(false);
        }
        let selection = &mut self.selections[size];
        if !self.chosen[size] {
            let rule = selection.rule(&self.energies, all.len(), settings);
            selection.apply(rule, all, &self.energies, all.len(), settings.seed);
            self.chosen[size] = true;
        }
        selection
    }
}

/// Converter of scatterers to element samples and an image line.
struct Imager {
    transmit: TransmitArray,
    receive: ArrayGeometry,
    former: LineFormer,
    transmit_leg: TransmitLeg,
    work: Workspace,
    frame: ElementFrame,
    line: Line,
}

impl Imager {
    fn new() -> Self {
        let mounting = Mounting {
            position_m: DVec3::ZERO,
            body_from_array: body_from_array(),
        };
        let face = Pattern::Rectangle {
            length_m: APERTURE_M,
            width_m: 0.0,
            baffled: true,
        };
        let limits = RowLimits {
            sample_rate_hz: SAMPLE_RATE_HZ,
            samples: SAMPLES,
            pulse_s: PULSE.duration_s,
        };
        let side = LineSpec {
            side: Side::Starboard,
            array: 0,
        };
        Self {
            transmit: TransmitArray {
                mounting,
                pattern: face,
                level_offset_db: 0.0,
            },
            receive: ArrayGeometry {
                mounting,
                elements: 1,
                spacing_m: 0.0,
                radius_m: None,
                element_pattern: face,
                sensitivity_db: -180.0,
                transmit: 0,
            },
            former: LineFormer::new(&side, limits, &PULSE),
            transmit_leg: TransmitLeg::new(),
            work: Workspace::new(),
            frame: ElementFrame {
                elements: 1,
                samples: SAMPLES,
                iq: vec![Complex64::ZERO; SAMPLES],
                ..ElementFrame::default()
            },
            line: Line {
                side: Side::Starboard,
                amplitude: Vec::new(),
            },
        }
    }

    fn ping(&mut self, at_m: DVec3, heard: &Scatterers, pass: &mut Pass) {
        let plan = plan(at_m);
        let window = Window::of_samples(FIRST_SAMPLE_S, SAMPLE_RATE_HZ, SAMPLES);
        insonify(&plan, &self.transmit, window, heard, &mut self.transmit_leg);
        self.frame.iq.fill(Complex64::ZERO);
        let mut sink = Direct::new(&plan, SAMPLE_RATE_HZ, FIRST_SAMPLE_S, &mut self.frame.iq);
        arrivals(
            &plan,
            &self.receive,
            0,
            &self.transmit_leg,
            &mut self.work,
            &mut sink,
        );
        self.former.form(&plan, &self.frame, &mut self.line);
        pass.iq.push(self.frame.iq.clone());
        let sample = |range_m: f64| (2.0 * range_m / SOUND_SPEED_M_PER_S * SAMPLE_RATE_HZ) as usize;
        let span = sample(IMAGE_M.0)..sample(IMAGE_M.1).min(self.line.amplitude.len());
        pass.energy.push(
            span.map(|k| {
                let range_m = 0.5 * SOUND_SPEED_M_PER_S * k as f64 / SAMPLE_RATE_HZ;
                let gain_db = 40.0 * range_m.log10() + 2.0 * ABSORPTION_DB_PER_M * range_m;
                f64::from(self.line.amplitude[k]).powi(2) * 10f64.powf(gain_db / 10.0)
            })
            .collect(),
        );
    }
}

/// Contribution of one seed to a row.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    kept: f64,
    energy: f64,
    energy_original: f64,
    blocks: f64,
    squared_db: f64,
    difference: f64,
    norm: f64,
}

impl Sums {
    fn of(original: &Pass, pass: &Pass, kept: f64) -> Self {
        let mut sums = Self {
            kept,
            energy: pass.energy.iter().flatten().sum(),
            energy_original: original.energy.iter().flatten().sum(),
            ..Self::default()
        };
        let (want, got) = (blocks(original), blocks(pass));
        let mut sorted = want.clone();
        sorted.sort_by(f64::total_cmp);
        let least = sorted[sorted.len() / 2] * 10f64.powf(SHADOW_DB / 10.0);
        for (want, got) in want.into_iter().zip(got) {
            if want > least {
                let db = (10.0 * (got / want).log10()).clamp(-CLIP_DB, CLIP_DB);
                sums.blocks += 1.0;
                sums.squared_db += db * db;
            }
        }
        for (a, b) in original.iq.iter().flatten().zip(pass.iq.iter().flatten()) {
            sums.difference += (a - b).norm_sqr();
            sums.norm += a.norm_sqr();
        }
        sums
    }

    fn figures(
        each: &[&Self],
        points: usize,
        once: SelectionTime,
        simplifier: Simplifier,
    ) -> Figures {
        let sum = |part: fn(&Self) -> f64| each.iter().map(|s| part(s)).sum::<f64>();
        let count = each.len() as f64;
        let level = |s: &&Self| 10.0 * (s.energy / s.energy_original).log10();
        let mean = each.iter().map(level).sum::<f64>() / count;
        let spread =
            each.iter().map(|s| (level(s) - mean).powi(2)).sum::<f64>() / (count - 1.0).max(1.0);
        Figures {
            points,
            once,
            simplifier,
            kept: sum(|s| s.kept) / count,
            level_db: 10.0 * (sum(|s| s.energy) / sum(|s| s.energy_original)).log10(),
            level_scatter_db: spread.sqrt(),
            image_db: (sum(|s| s.squared_db) / sum(|s| s.blocks)).sqrt(),
            l2: (sum(|s| s.difference) / sum(|s| s.norm)).sqrt(),
        }
    }
}

/// Energy of every complete block.
fn blocks(pass: &Pass) -> Vec<f64> {
    let samples = pass.energy[0].len();
    let mut energies = Vec::new();
    for pings in pass.energy.chunks_exact(BLOCK_PINGS) {
        for first in (0..samples - samples % BLOCK_SAMPLES).step_by(BLOCK_SAMPLES) {
            let span = first..first + BLOCK_SAMPLES;
            energies.push(
                pings
                    .iter()
                    .map(|line| line[span.clone()].iter().sum::<f64>())
                    .sum(),
            );
        }
    }
    energies
}

const PULSE: Pulse = Pulse {
    kind: PulseKind::LfmUp,
    center_frequency_hz: CARRIER_HZ,
    bandwidth_hz: 30e3,
    duration_s: 5e-3,
    taper: 0.0,
};

fn plan(at_m: DVec3) -> PingPlan {
    let velocity_m_per_s = DVec3::X * SPEED_M_PER_S;
    PingPlan {
        ping_period_s: 0.16,
        settings: SonarSettings {
            pinging: true,
            range_m: 82.0,
            max_ping_rate_hz: 6.0,
            source_level_db: 210.0,
            gain_db: 0.0,
            pulse_duration_s: PULSE.duration_s,
        },
        ping_rate_hz: 6.0,
        pulse: PULSE,
        sound_speed_m_per_s: SOUND_SPEED_M_PER_S,
        absorption_db_per_m: ABSORPTION_DB_PER_M,
        sample_count: SAMPLES,
        first_sample_s: FIRST_SAMPLE_S,
        ..rig::uniform(at_m, velocity_m_per_s, DQuat::IDENTITY)
    }
}
