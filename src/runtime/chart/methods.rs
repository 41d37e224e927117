//! The methods and settings that a chart compares.

use std::fmt;

use echotank_config::spec::SonarSpec;
use echotank_core::flow::{DopplerModel, ModelChoice, PathModel, ReceiverFilter, Synthesis};

/// One choice of path, Doppler and synthesis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Method {
    pub path: PathModel,
    /// Longest segment of paths that have any; 0 for the others.
    pub segment_s: f64,
    pub doppler: DopplerModel,
    pub synthesis: Synthesis,
    /// What a synthesis that keeps one is made for; 0 for the others.
    pub tolerance: f64,
    /// Scatterers whose two-way pattern is below this are left out, dB; none keeps all.
    pub cull_db: Option<f64>,
}

/// What all others are held against.
pub fn reference() -> Method {
    Method::new(
        PathModel::Continuous,
        0.0,
        DopplerModel::StretchQuadratic,
        Synthesis::Direct,
        0.0,
    )
}

/// Tolerances that engines are made for.
const TOLERANCES: [f64; 6] = [1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6];
const QUICK_TOLERANCES: [f64; 2] = [1e-2, 1e-3];
/// Segments, seconds.
const LONG_S: f64 = 0.05;
const MIDDLE_S: f64 = 0.01;
const SHORT_S: f64 = 0.002;

/// Every method for this sonar, its own configuration among them.
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
    // Culled as the configuration has it and, where that leaves something out, with all scatterers too.
    let mut add = |method: Method, all_too: bool| {
        let culled = method.culling(own.cull_db);
        for method in [culled, method].into_iter().take(1 + usize::from(all_too)) {
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
        }
    }
    methods
}

impl Method {
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

    /// The configuration's own.
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

    /// The same with its sum made for another tolerance.
    pub(super) fn made_for(self, tolerance: f64) -> Self {
        Self {
            tolerance: match self.synthesis.keeps_tolerance() {
                true => tolerance,
                false => 0.0,
            },
            ..self
        }
    }

    /// The sonar under this choice; everything else stays.
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

    /// Why a configuration would refuse this choice for this sonar.
    pub fn applies(&self, sonar: &SonarSpec) -> Result<(), String> {
        if !self.synthesis.takes(self.doppler) {
            return Err(format!("takes no Doppler {}", self.doppler.name()));
        }
        let filtered = sonar.receiver.filter == ReceiverFilter::Fir;
        match (self.synthesis, self.path) {
            (Synthesis::Gridded2d, PathModel::Polyline) => {
                Err("the polyline's steps of attitude tear a line apart".into())
            }
            (Synthesis::Gridded2d, _) if !filtered => Err("wants the receiver filter".into()),
            _ => Ok(()),
        }
    }

    /// What moves, in words.
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
