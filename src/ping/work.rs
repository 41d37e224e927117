//! Amounts of work, kind by kind: what the costs of methods are made of.
//!
//! One list says what the kinds are, what a table of costs calls them and what they mean; everything else goes by [`Figure`].

use std::ops::{Index, IndexMut};

macro_rules! figures {
    ($($variant:ident $name:literal $doc:literal;)*) => {
        /// A kind of work that a table of costs has a figure for, in nanoseconds of one core for each unit of it.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum Figure {
            $(#[doc = $doc] $variant,)*
        }

        impl Figure {
            /// All kinds, in the order of the table.
            pub const ALL: &'static [Self] = &[$(Self::$variant,)*];

            /// As a table of costs calls it.
            pub fn name(self) -> &'static str {
                match self {
                    $(Self::$variant => $name,)*
                }
            }

            /// What one unit of it is.
            pub fn meaning(self) -> &'static str {
                match self {
                    $(Self::$variant => $doc,)*
                }
            }
        }
    };
}

figures! {
    Ping "ping" "a ping, whatever is in it";
    Element "element" "an element of a ping";
    Sample "sample" "a sample of an element, whatever made it";
    TransmitLegTerms "transmit_leg" "a scatterer as a transmitter sees it";
    Pair "pair" "an insonified scatterer at an element: its second leg's level, and where it goes";
    Pattern "pattern" "... where the element has a pattern";
    Chord "chord" "an insonified scatterer at an element, for each leg of the path that is looked at";
    Newton "newton" "an insonified scatterer at an element on the exact trajectory";
    Attitude "attitude" "an attitude between two of the track, on the exact trajectory";
    PartElement "part_element" "an element of a part of a line, for each insonified scatterer";
    Quadratic "quadratic" "the second order of an echo's Doppler";
    DirectRun "direct_run" "a run of samples of an echo in `direct`: sines and cosines anew";
    DirectPoint "direct_point" "a point of an echo in `direct`";
    DirectFlank "direct_flank" "... more, on a taper's flank";
    DirectEdge "direct_edge" "an end of a smooth piece of an echo in `direct` behind the receiver filter";
    ReferencePoint "reference_point" "a point of an echo in `reference`";
    SpectralBin "spectral_bin" "a bin of an echo in `spectral`";
    ReplicaEcho "replica_echo" "an echo in `nearest` and `linear`";
    ReplicaSample "replica_sample" "a sample of an echo in `nearest`; `linear` has two";
    FilterTap "filter_tap" "a tap of the receiver filter, for each sample behind it";
    Gridded1dEcho "gridded_1d_echo" "cost estimate of `gridded-1d` for its echoes, in its own ns";
    Gridded1dGrid "gridded_1d_grid" "cost estimate of `gridded-1d` for its grids, in its own ns";
    Gridded2dEcho "gridded_2d_echo" "cost estimate of `gridded-2d` for its echoes, in its own ns";
    Gridded2dGrid "gridded_2d_grid" "cost estimate of `gridded-2d` for its grids, in its own ns";
    GriddedLinesEcho "gridded_lines_echo" "cost estimate of `gridded-lines` for its echoes, in its own ns";
    GriddedLinesGrid "gridded_lines_grid" "cost estimate of `gridded-lines` for its grids, in its own ns";
    Tile "tile" "a tile of the seabed in reach of a ping";
    Made "made" "a scatterer of the seabed made anew";
    Tested "tested" "a scatterer of the seabed that a ping may keep";
    Gathered "gathered" "... that it keeps";
    SurfaceScatterer "surface_scatterer" "a scatterer of the sea surface in a footprint";
    WaterScatterer "water_scatterer" "a scatterer of the water";
    ReflectedPair "reflected_pair" "a pair of legs by surface and bottom to a scatterer";
    Wave "wave" "a place of the surface whose waves move an echo";
    Ray "ray" "a ray through water that bends sound";
    Noise "noise" "a sample of an element's noise";
    Received "received" "a sample of an element through gain and converter";
    BeamTransform "beam_transform" "a point of a beamformer's transform, for each doubling of its length";
    BeamProduct "beam_product" "a complex product of a beamformer";
    BeamZone "beam_zone" "a group of elements of a beam, for each of its focal zones";
    BeamSample "beam_sample" "a sample of a beam, whatever formed it";
    BottomSample "bottom_sample" "a sample of a beam in which the bottom is looked for";
    RecordIq "record_iq" "a sample of an element or a beam in a record, I and Q";
    RecordAmplitude "record_amplitude" "an amplitude of a beam or a line in a record";
    RecordPassband "record_passband" "a passband sample of an element in a record";
}

/// Number of kinds of work.
pub const FIGURES: usize = Figure::ALL.len();

impl Figure {
    /// Whether the choice of methods decides how much of it there is. The others are those of [`crate::ping_cost`].
    pub fn is_of_methods(self) -> bool {
        (self as usize) < Self::Tile as usize
    }
}

/// Amounts of each kind.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Work([f64; FIGURES]);

impl Work {
    /// No work.
    pub const NONE: Self = Self([0.0; FIGURES]);

    /// With this much of one kind.
    pub fn of(figure: Figure, amount: f64) -> Self {
        Self::NONE.and(figure, amount)
    }

    /// ... and so much more of another.
    pub fn and(mut self, figure: Figure, amount: f64) -> Self {
        self[figure] += amount;
        self
    }

    /// All of both.
    pub fn plus(mut self, other: &Self) -> Self {
        for &figure in Figure::ALL {
            self[figure] += other[figure];
        }
        self
    }
}

impl Index<Figure> for Work {
    type Output = f64;
    fn index(&self, figure: Figure) -> &f64 {
        &self.0[figure as usize]
    }
}

impl IndexMut<Figure> for Work {
    fn index_mut(&mut self, figure: Figure) -> &mut f64 {
        &mut self.0[figure as usize]
    }
}
