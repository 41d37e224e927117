//! Text names of choices, in the configuration and in the texts of the program.

use super::*;

/// Choice without parameters that has a text name.
pub trait NamedChoice: Copy + PartialEq + 'static {
    /// All choices with their text names.
    const WORDS: &'static [(Self, &'static str)];

    /// Text name of the choice.
    fn word(self) -> &'static str {
        let own = Self::WORDS.iter().find(|(choice, _)| *choice == self);
        own.expect("every choice has its word").1
    }

    /// The choice with this text name.
    fn from_word(word: &str) -> Option<Self> {
        let found = Self::WORDS.iter().find(|(_, own)| *own == word);
        found.map(|(choice, _)| *choice)
    }
}

macro_rules! words {
    ($($choices:ident: $($choice:ident = $word:literal),+;)+) => {
        $(impl NamedChoice for $choices {
            const WORDS: &'static [(Self, &'static str)] = &[$((Self::$choice, $word)),+];
        })+
    };
}

words! {
    AnchorSpec: Origin = "origin", FirstFix = "first-fix", File = "file";
    BeamSpacing: EquiAngle = "equi-angle", EquiDistant = "equi-distant", EquiSine = "equi-sine";
    ChecksumPolicy: Require = "require", AcceptMissing = "accept-missing", Ignore = "ignore";
    ColourMap: Copper = "copper", Grey = "grey", Blue = "blue", Rainbow = "rainbow";
    EarlyTrigger: Refuse = "refuse", Queue = "queue";
    FirstRow: North = "north", South = "south";
    Former: Exact = "exact", Fft = "fft", TimeDelay = "conventional", Phase = "phase", DynamicFocus = "dynamic-focus";
    HeightSign: Elevation = "elevation", Depth = "depth";
    IncidenceSpec: Normal = "normal", Flat = "flat";
    JsfChannels: Sides = "sides", Staves = "staves";
    JsfFormat: Envelope = "envelope", Analytic = "analytic", Unfiltered = "unfiltered";
    SynthesisOutput: Elements = "elements", Beams = "beams", Auto = "auto";
    NavChannel: Position = "position", CourseSpeed = "course-speed", Heading = "heading", RollPitch = "roll-pitch", Heave = "heave", Depth = "depth";
    NavFormat: Nmea = "nmea", Tss1 = "tss1", Em3000 = "em3000", Seapath26 = "seapath26", Kmb = "kmb";
    NavSentence: Zda = "ZDA", Gga = "GGA", Hdt = "HDT";
    OcclusionSpec: None = "none", Horizon = "horizon", Paper = "paper";
    OnLost: Skip = "skip", Hold = "hold";
    OutLine: RequestToSend = "rts", DataTerminalReady = "dtr";
    OverloadSpec: Skip = "skip", Degrade = "degrade", Stretch = "stretch";
    Overlap: Nearest = "nearest", Mean = "mean", Last = "last";
    PaperShape: Curves = "paper-curves", Relief = "paper-relief", Lake = "paper-lake";
    PictureRange: Slant = "slant", Ground = "ground", GroundFirstReturn = "ground-first-return";
    PulseSpec: None = "none", Rts = "rts", Dtr = "dtr", Byte = "byte";
    SeabedFormat: EsriAscii = "esri-ascii", GeoTiff = "geotiff", Bag = "bag", Xyz = "xyz", Las = "las", Ply = "ply";
    Sediment: Mud = "mud", Silt = "silt", Sand = "sand", Gravel = "gravel", Rock = "rock";
    Side: Port = "port", Starboard = "starboard";
    SimplifyMethod: Acoustic = "acoustic", Paper = "paper", Unbiased = "acoustic-unbiased";
    StampSpec: Log = "log", Host = "host";
}
