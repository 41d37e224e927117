//! Methods and settings that a chart compares.

use std::fmt;

use echotank_config::spec::SonarSpec;
use echotank_core::arrays::ReceiverFilter;
use echotank_core::model::{DopplerModel, ModelChoice, PathModel, Synthesis};
use echotank_synthesis::array::lines::MIN_TOLERANCE;

/// One choice of path, Doppler and synthesis, with settings.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Method {
    /// Path model.
    pub path: PathModel,
    /// Longest segment of a segmented path, seconds; 0 for other paths.
    pub segment_s: f64,
    /// Doppler model.
    pub doppler: DopplerModel,
    /// Synthesis engine.
    pub synthesis: Synthesis,
    /// Relative tolerance of engines with a tolerance; 0 for other engines.
    pub tolerance: f64,
    /// Scatterers with a two-way beam pattern below this level are omitted, dB; `None` keeps all.
    pub cull_db: Option<f64>,
}

/// Method of the reference solution.
pub fn reference() -> Method {
    Method::new(
        PathModel::Continuous,
        0.0,
        DopplerModel::StretchQuadratic,
        Synthesis::Direct,
        0.0,
    )
}

/// Tolerances of the gridded engines.
const TOLERANCES: [f64; 6] = [1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6];
const QUICK_TOLERANCES: [f64; 2] = [1e-2, 1e-3];
/// Segment lengths, seconds.
const LONG_S: f64 = 0.05;
const MIDDLE_S: f64 = 0.01;
const SHORT_S: f64 = 0.002;

/// All methods for this sonar, the configured method first. `quick` omits some methods.
pub fn all(sonar: &SonarSpec, quick: bool) -> Vec<Method> {
    use DopplerModel::{None, PaperEq21, Stretch, StretchQuadratic};
    use PathModel::{Continuous, KSegment, Polyline, StopAndHop};
    let motions = [
        (StopAndHop, 0.0, None),
        (StopAndHop, 0.0, Stretch),
        (Polyline, LONG_S, None),
        (Polyline, LONG_S, Stretch),
        (Polyline, MIDDLE_S, Stretch),
        (KSegment, LONG_S, Stretch),
        (KSegment, MIDDLE_S, Stretch),
        (KSegment, MIDDLE_S, StretchQuadratic),
        (KSegment, SHORT_S, StretchQuadratic),
        (Continuous, 0.0, StretchQuadratic),
    ];
    let own = Method::of(sonar);
    let mut methods = vec![own];
    // Adds the method with the configured culling, and on request also without culling.
    let mut add = |method: Method, also_unculled: bool| {
        let culled = method.culling(own.cull_db);
        let count = 1 + usize::from(also_unculled);
        for method in [culled, method].into_iter().take(count) {
            if !methods.contains(&method) {
                methods.push(method);
            }
        }
    };
    for (path, segment_s, doppler) in motions {
        if !quick || segment_s != SHORT_S {
            let method = Method::new(path, segment_s, doppler, Synthesis::Direct, 0.0);
            add(method, doppler == StretchQuadratic);
        }
    }
    let printed = Method::new(Polyline, LONG_S, PaperEq21, Synthesis::Direct, 0.0);
    add(printed, false);
    for synthesis in [Synthesis::Nearest, Synthesis::Linear, Synthesis::Spectral] {
        add(Method::new(StopAndHop, 0.0, None, synthesis, 0.0), false);
        if !quick {
            add(Method::new(KSegment, MIDDLE_S, None, synthesis, 0.0), false);
        }
    }
    let tolerances: &[f64] = if quick {
        &QUICK_TOLERANCES
    } else {
        &TOLERANCES
    };
    let lines = sonar.receive.iter().all(|array| array.elements > 1);
    for &tolerance in tolerances {
        for (path, segment_s, doppler) in [
            (StopAndHop, 0.0, None),
            (KSegment, MIDDLE_S, Stretch),
            (KSegment, MIDDLE_S, StretchQuadratic),
        ] {
            let engine = |synthesis| Method::new(path, segment_s, doppler, synthesis, tolerance);
            add(engine(Synthesis::Gridded1d), doppler == Stretch);
            if lines {
                add(engine(Synthesis::Gridded2d), doppler == Stretch);
            }
            if lines && tolerance >= MIN_TOLERANCE {
                add(engine(Synthesis::GriddedLines), doppler == Stretch);
            }
        }
    }
    methods
}

impl Method {
    /// Creates a method without culling.
    pub fn new(
        path: PathModel,
        segment_s: f64,
        doppler: DopplerModel,
        synthesis: Synthesis,
        tolerance: f64,
    ) -> Self {
        Self {
            path,
            segment_s,
            doppler,
            synthesis,
            tolerance,
            cull_db: None,
        }
    }

    fn culling(self, cull_db: Option<f64>) -> Self {
        Self { cull_db, ..self }
    }

    /// Configured method of a sonar.
    pub fn of(sonar: &SonarSpec) -> Self {
        let ModelChoice {
            path,
            doppler,
            synthesis,
            segment_s,
            cull_db,
        } = sonar.model;
        let segmented = matches!(path, PathModel::Polyline | PathModel::KSegment);
        Self {
            path,
            segment_s: if segmented { segment_s } else { 0.0 },
            doppler,
            synthesis,
            tolerance: match synthesis.keeps_tolerance() {
                true => sonar.synthesis.tolerance,
                false => 0.0,
            },
            cull_db,
        }
    }

    /// The same method with another engine tolerance.
    pub(super) fn with_tolerance(self, tolerance: f64) -> Self {
        Self {
            tolerance: match self.synthesis.keeps_tolerance() {
                true => tolerance,
                false => 0.0,
            },
            ..self
        }
    }

    /// Specification of the sonar with this method; everything else is unchanged.
    pub fn on(&self, sonar: &SonarSpec) -> SonarSpec {
        let mut spec = sonar.clone();
        spec.model.path = self.path;
        spec.model.doppler = self.doppler;
        spec.model.synthesis = self.synthesis;
        spec.model.cull_db = self.cull_db;
        if self.segment_s > 0.0 {
            spec.model.segment_s = self.segment_s;
        }
        if self.tolerance > 0.0 {
            spec.synthesis.tolerance = self.tolerance;
        }
        spec
    }

    /// Whether this sonar can use the method.
    ///
    /// # Errors
    /// The reason why it cannot.
    pub fn applies(&self, sonar: &SonarSpec) -> Result<(), String> {
        if !self.synthesis.takes(self.doppler) {
            return Err(format!("does not support Doppler {}", self.doppler.name()));
        }
        let filtered = sonar.receiver.filter == ReceiverFilter::Fir;
        match (self.synthesis, self.path) {
            (lines, PathModel::Polyline) if lines.makes_lines() => {
                Err("the polyline's attitude steps break up an array line".into())
            }
            (lines, _) if lines.makes_lines() && !filtered => {
                Err("needs the receiver filter".into())
            }
            _ => Ok(()),
        }
    }

    /// Path and Doppler models as text.
    pub fn motion(&self) -> String {
        let path = match self.segment_s > 0.0 {
            true => format!("{} {} ms", self.path.name(), self.segment_s * 1e3),
            false => self.path.name().to_owned(),
        };
        match self.doppler {
            DopplerModel::None => format!("{path}, no Doppler"),
            doppler => format!("{path}, {}", doppler.name()),
        }
    }
}

impl fmt::Display for Method {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.synthesis.name())?;
        if self.tolerance > 0.0 {
            write!(f, " {:.0e}", self.tolerance)?;
        }
        write!(f, ", {}", self.motion())?;
        match self.cull_db {
            Some(db) => write!(f, ", culled at {db:.0} dB"),
            None => Ok(()),
        }
    }
}
