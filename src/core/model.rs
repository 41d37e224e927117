//! The methods with which a ping is modelled.

/// Model of the platform motion during the listening window.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PathModel {
    /// The platform is at rest during the window.
    StopAndHop,
    /// The platform moves along the segments of the plan: constant velocity and attitude on each, with a step of the attitude
    /// between them.
    Polyline,
    /// Each element moves along its own chords between the vertices of the plan, without steps. Chords include the rotation of an
    /// element on a lever arm.
    KSegment,
    /// Exact position and attitude at the time of reception.
    Continuous,
}

/// Model of the Doppler effect on echoes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DopplerModel {
    /// No Doppler effect.
    None,
    /// Each echo is stretched uniformly about its leading edge.
    Stretch,
    /// Each echo is stretched about the middle of the pulse, with the change of the stretch during the pulse.
    StretchQuadratic,
    /// Eq. 21 of Meng et al. 2023 as printed: delays stretched, pulse not. For comparison.
    PaperEq21,
}

/// Method that sums echoes to element samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Synthesis {
    /// Retarded time of every sample on the continuous trajectory: the slow reference solution.
    Reference,
    /// Linearised sum with the selected path and Doppler models.
    Direct,
    /// Eqs. 18 and 21 of Meng et al. 2023 on their frequency grid.
    Spectral,
    /// Replica of each echo, placed at the nearest sample.
    Nearest,
    /// Replica of each echo, interpolated linearly between samples.
    Linear,
    /// Echoes gridded and transformed per element, within a tolerance.
    Gridded1d,
    /// Echoes gridded over delay and slope and transformed for a whole line array, within a tolerance.
    Gridded2d,
}

/// Selected models and method of a ping.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ModelChoice {
    /// Motion model.
    pub path: PathModel,
    /// Doppler model.
    pub doppler: DopplerModel,
    /// Synthesis method.
    pub synthesis: Synthesis,
    /// Maximum length of a polyline segment, seconds.
    pub segment_s: f64,
    /// Scatterers are culled if their two-way pattern (transmit times element, relative to boresight) is below this level, dB
    /// (negative). [`Scatterers::loud`](crate::scene::Scatterers::loud) lowers the level of single scatterers. `None` keeps all.
    pub cull_db: Option<f64>,
}

impl PathModel {
    /// All models.
    pub const ALL: [Self; 4] = [
        Self::StopAndHop,
        Self::Polyline,
        Self::KSegment,
        Self::Continuous,
    ];
    /// Name in the configuration and in records.
    pub fn name(self) -> &'static str {
        match self {
            Self::StopAndHop => "stop-and-hop",
            Self::Polyline => "polyline",
            Self::KSegment => "k-segment",
            Self::Continuous => "continuous",
        }
    }
}

impl DopplerModel {
    /// All models.
    pub const ALL: [Self; 4] = [
        Self::None,
        Self::Stretch,
        Self::StretchQuadratic,
        Self::PaperEq21,
    ];
    /// Name in the configuration and in records.
    pub fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Stretch => "stretch",
            Self::StretchQuadratic => "stretch-quadratic",
            Self::PaperEq21 => "paper-eq21",
        }
    }
    /// Whether the pulse is unchanged, so that one spectrum or replica serves every echo.
    pub fn keeps_pulse(self) -> bool {
        matches!(self, Self::None | Self::PaperEq21)
    }
}

impl Synthesis {
    /// All methods.
    pub const ALL: [Self; 7] = [
        Self::Reference,
        Self::Direct,
        Self::Spectral,
        Self::Nearest,
        Self::Linear,
        Self::Gridded1d,
        Self::Gridded2d,
    ];
    /// Name in the configuration and in records.
    pub fn name(self) -> &'static str {
        match self {
            Self::Reference => "reference",
            Self::Direct => "direct",
            Self::Spectral => "spectral",
            Self::Nearest => "nearest",
            Self::Linear => "linear",
            Self::Gridded1d => "gridded-1d",
            Self::Gridded2d => "gridded-2d",
        }
    }
    /// Whether all echoes share one pulse; such methods need a model that [`DopplerModel::keeps_pulse`].
    pub fn shares_pulse(self) -> bool {
        matches!(self, Self::Spectral | Self::Nearest | Self::Linear)
    }
    /// Whether the method is built for a tolerance and meets it.
    pub fn keeps_tolerance(self) -> bool {
        matches!(self, Self::Gridded1d | Self::Gridded2d)
    }
    /// Whether the method supports this Doppler model.
    pub fn takes(self, doppler: DopplerModel) -> bool {
        match self {
            Self::Reference | Self::Direct => true,
            Self::Spectral | Self::Nearest | Self::Linear => doppler.keeps_pulse(),
            Self::Gridded1d | Self::Gridded2d => doppler != DopplerModel::PaperEq21,
        }
    }
}
