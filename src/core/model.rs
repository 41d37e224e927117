//! Models of motion and Doppler, and the synthesis methods, of a ping.

/// Model of the platform motion during the listening window.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PathModel {
    /// The platform is at rest during the window.
    StopAndHop,
    /// The platform moves along the segments of the plan. Velocity and attitude are constant on each segment; the attitude steps
    /// between segments.
    Polyline,
    /// Each element moves along straight chords between the vertices of the plan, without steps. The chords include the rotation of
    /// an element on a lever arm.
    KSegment,
    /// The trajectory gives position and attitude at each time of reception, without approximation.
    Continuous,
}

/// Model of the Doppler effect on echoes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DopplerModel {
    /// No Doppler effect.
    None,
    /// Each echo is stretched uniformly about its leading edge.
    Stretch,
    /// Each echo is stretched about the middle of the pulse. The stretch changes linearly during the pulse.
    StretchQuadratic,
    /// Eq. 21 of Meng et al. 2023 as printed: delays are stretched and the pulse is not. For comparison only.
    PaperEq21,
}

/// Method that adds echoes into element samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Synthesis {
    /// Sum at the retarded time of every sample on the continuous trajectory: the slow reference solution.
    Reference,
    /// Linearised sum with the selected path and Doppler models.
    Direct,
    /// Eqs. 18 and 21 of Meng et al. 2023 on their frequency grid.
    Spectral,
    /// Sum of replicas of the pulse, each placed at the nearest sample.
    Nearest,
    /// Sum of replicas of the pulse, each interpolated linearly between samples.
    Linear,
    /// Echoes are spread on a delay grid and transformed per element, within a tolerance.
    Gridded1d,
    /// Echoes are spread on a grid of delay and slope and transformed for a whole line array, within a tolerance.
    Gridded2d,
    /// Echoes gridded over delay and Doppler and transformed for 16 neighbouring elements of a line array at a time, within a tolerance.
    GriddedLines,
}

/// Motion model, Doppler model and synthesis method of a ping.
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
    /// Whether the model leaves the pulse unchanged, so that one spectrum or replica serves every echo.
    pub fn keeps_pulse(self) -> bool {
        matches!(self, Self::None | Self::PaperEq21)
    }
}

impl Synthesis {
    /// All methods.
    pub const ALL: [Self; 8] = [
        Self::Reference,
        Self::Direct,
        Self::Spectral,
        Self::Nearest,
        Self::Linear,
        Self::Gridded1d,
        Self::Gridded2d,
        Self::GriddedLines,
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
            Self::GriddedLines => "gridded-lines",
        }
    }
    /// Whether all echoes share one pulse. Such methods need a model with [`DopplerModel::keeps_pulse`].
    pub fn shares_pulse(self) -> bool {
        matches!(self, Self::Spectral | Self::Nearest | Self::Linear)
    }
    /// Whether the method is designed for a tolerance and meets it.
    pub fn keeps_tolerance(self) -> bool {
        matches!(self, Self::Gridded1d | Self::Gridded2d | Self::GriddedLines)
    }
    /// Whether the method makes whole line arrays: behind the receiver filter, and on paths without steps of the attitude.
    pub fn makes_lines(self) -> bool {
        matches!(self, Self::Gridded2d | Self::GriddedLines)
    }
    /// Whether the method supports this Doppler model.
    pub fn takes(self, doppler: DopplerModel) -> bool {
        match self {
            Self::Reference | Self::Direct => true,
            Self::Spectral | Self::Nearest | Self::Linear => doppler.keeps_pulse(),
            Self::Gridded1d | Self::Gridded2d | Self::GriddedLines => {
                doppler != DopplerModel::PaperEq21
            }
        }
    }
}
