//! `echotank scene simplify`: reduces a seabed to the scatterers that matter for one sonar.

use std::fmt::Write as _;
use std::path::PathBuf;

use clap::{Args, ValueEnum};
use glam::DVec3;

use crate::cli::Failure;
use echotank_config::spec::{EnergyWeights, SeabedFileSpec, SimplifyMethod};
use echotank_core::scene::Scatterers;
use echotank_runtime::io::files::FileSystem;
use echotank_scene::read::Survey;
use echotank_scene::simplify::collapse::collapse;
use echotank_scene::simplify::energy::{Beam, View};
use echotank_scene::simplify::{Selection, Settings, field, select};

/// -3 dB beam width of a uniform line array times its length in wavelengths, radians.
const BEAM_WIDTH: f64 = 0.886;

#[derive(Args, Clone, Debug)]
pub(crate) struct SimplifyArgs {
    /// Seabed: any file that `echotank scene info` reads
    pub(crate) file: PathBuf,
    /// Selection method
    #[arg(long, value_enum)]
    pub(crate) method: MethodArg,
    /// Number of scatterers to keep; acoustic-unbiased keeps this many on average
    #[arg(long)]
    pub(crate) keep: usize,
    /// CSV of the kept scatterers, in the format of scene.points: north_m,east_m,down_m,amplitude,amplitude_imag
    #[arg(long)]
    pub(crate) out: PathBuf,
    /// Sonar position: north,east,down in metres from the seabed's origin; optional for conventional. Amplitudes then include the angle of
    /// incidence, because explicit points have no normals
    #[arg(long, value_name = "N,E,D", value_parser = parse_place, allow_hyphen_values = true)]
    pub(crate) sonar: Option<DVec3>,
    /// Beam width along the track, degrees between one-way -3 dB points, on transmit and receive [default: omnidirectional]
    #[arg(long, value_parser = parse_positive)]
    pub(crate) beam_deg: Option<f64>,
    /// Heading of the track, along which the beam is narrow
    #[arg(long, default_value_t = 0.0, allow_hyphen_values = true)]
    pub(crate) heading_deg: f64,
    /// The selection stays valid while the sonar is within this distance
    #[arg(long, default_value_t = 0.0, value_parser = parse_not_negative)]
    pub(crate) hold_m: f64,
    /// Weights of curvature, scattering, axis and the product scattering x axis [default: 1,1,1,0; 0,0,0,1 for acoustic-unbiased]
    #[arg(long, value_name = "C,S,A,E", value_parser = parse_weights)]
    pub(crate) weights: Option<EnergyWeights>,
    /// With conventional: kept scatterers inherit the area of removed ones
    #[arg(long)]
    pub(crate) inherit_area: bool,
    /// Lambert's law backscattering coefficient mu, dB
    #[arg(long, default_value_t = -27.0, allow_hyphen_values = true)]
    pub(crate) lambert_db: f64,
    /// Seed of speckle and of the random selection
    #[arg(long, default_value_t = 1)]
    pub(crate) seed: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum MethodArg {
    /// Highest energies (Meng et al. 2023, corrected)
    Acoustic,
    /// Highest energies, exactly as published
    Paper,
    /// Random selection, weighted to keep the mean level
    AcousticUnbiased,
    /// Quadric-error edge collapse
    Conventional,
}

pub(crate) fn main(args: &SimplifyArgs) -> Result<(), Failure> {
    if !(args.heading_deg.is_finite() && args.lambert_db.abs() <= 100.0) {
        let text = "--heading-deg must be finite and --lambert-db between -100 and 100";
        return Err(Failure::Configuration(text.into()));
    }
    let asked = SeabedFileSpec::of(args.file.clone());
    let survey =
        Survey::open(&FileSystem, &asked).map_err(|e| Failure::Configuration(e.to_string()))?;
    let (all, triangles) = field::scatterers(&survey.field, args.lambert_db, args.seed);
    let method = match args.method {
        MethodArg::Acoustic => Some(SimplifyMethod::Acoustic),
        MethodArg::Paper => Some(SimplifyMethod::Paper),
        MethodArg::AcousticUnbiased => Some(SimplifyMethod::Unbiased),
        MethodArg::Conventional => None,
    };
    let chosen = match (method, args.sonar) {
        (None, _) => collapsed(&all, &triangles, args),
        (Some(_), None) => {
            let text = "--sonar N,E,D is required: energies depend on the sonar position";
            return Err(Failure::Configuration(text.into()));
        }
        (Some(method), Some(apex_m)) => {
            let settings = Settings {
                method,
                keep: args.keep,
                weights: args.weights.unwrap_or(EnergyWeights::default_of(method)),
                seed: args.seed,
            };
            select(&all, all.len(), &view(args, apex_m), &settings)
        }
    };
    let mut kept = Scatterers::default();
    chosen.gather(&all, &mut kept);
    if let Some(apex_m) = args.sonar {
        face(&mut kept, apex_m);
    }
    let text = csv(&kept).map_err(Failure::running)?;
    std::fs::write(&args.out, text)
        .map_err(|e| Failure::Running(format!("{}: {e}", args.out.display())))?;
    println!(
        "kept {} of {} scatterers in {}",
        kept.len(),
        all.len(),
        args.out.display()
    );
    Ok(())
}

fn collapsed(all: &Scatterers, triangles: &[[u32; 3]], args: &SimplifyArgs) -> Selection {
    let places: Vec<DVec3> = (0..all.len()).map(|i| all.position_m(i)).collect();
    let left = collapse(&places, triangles, args.keep);
    let gain = match args.inherit_area {
        true => left.area_share.iter().map(|share| share.sqrt()).collect(),
        false => vec![1.0; left.kept.len()],
    };
    Selection::of(left.kept, gain)
}

fn view(args: &SimplifyArgs, apex_m: DVec3) -> View {
    let (sin, cos) = libm::sincos(args.heading_deg.to_radians());
    let beam = |deg: f64| Beam {
        along: DVec3::new(cos, sin, 0.0),
        across: DVec3::new(-sin, cos, 0.0),
        boresight: DVec3::Z,
        lengths: [BEAM_WIDTH / deg.to_radians(); 2],
        widths: [0.0; 2],
        baffled: false,
    };
    View {
        apex_m,
        beams: args.beam_deg.map(beam).into_iter().collect(),
        slack_m: args.hold_m,
        slack_rad: 0.0,
        shadows: true,
    }
}

/// Multiplies the amplitudes by the angle factor of Lambert's law for one sonar position.
fn face(kept: &mut Scatterers, apex_m: DVec3) {
    for i in 0..kept.len() {
        let ray = (kept.position_m(i) - apex_m).normalize_or_zero();
        let normal = DVec3::from_array(kept.normal[i].map(f64::from));
        kept.strength[i] *= (-normal.dot(ray)).max(0.0);
    }
}

fn csv(kept: &Scatterers) -> Result<String, std::fmt::Error> {
    let mut text = String::from("north_m,east_m,down_m,amplitude,amplitude_imag\n");
    for i in 0..kept.len() {
        let (at, strength) = (kept.position_m(i), kept.strength[i]);
        writeln!(
            text,
            "{},{},{},{:e},{:e}",
            at.x, at.y, at.z, strength.re, strength.im
        )?;
    }
    Ok(text)
}

fn numbers<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let values: Vec<f64> = text
        .split(',')
        .map(|part| part.trim().parse().ok().filter(|v: &f64| v.is_finite()))
        .collect::<Option<_>>()
        .ok_or_else(|| format!("expected {N} comma-separated numbers"))?;
    values
        .try_into()
        .map_err(|_| format!("expected {N} comma-separated numbers"))
}

fn parse_place(text: &str) -> Result<DVec3, String> {
    numbers::<3>(text).map(DVec3::from_array)
}

fn parse_weights(text: &str) -> Result<EnergyWeights, String> {
    let [curvature, scattering, axis, echo] = numbers::<4>(text)?;
    if [curvature, scattering, axis, echo].iter().any(|w| *w < 0.0) {
        return Err("weights must not be negative".into());
    }
    Ok(EnergyWeights {
        curvature,
        scattering,
        axis,
        echo,
    })
}

fn parse_positive(text: &str) -> Result<f64, String> {
    let [value] = numbers::<1>(text)?;
    if value > 0.0 && value <= 180.0 {
        Ok(value)
    } else {
        Err("must be above 0 and at most 180 degrees".into())
    }
}

fn parse_not_negative(text: &str) -> Result<f64, String> {
    let [value] = numbers::<1>(text)?;
    if value >= 0.0 {
        Ok(value)
    } else {
        Err("must not be negative".into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn args(dir: &std::path::Path, method: MethodArg) -> SimplifyArgs {
        let mut text =
            String::from("ncols 30\nnrows 20\nxllcorner 500000\nyllcorner 4000000\ncellsize 1\n");
        for k in 0..600 {
            let _ = writeln!(
                text,
                "{}",
                -30.0
                    + if k % 30 == 12 {
                        2.0
                    } else {
                        0.01 * f64::from(k % 7)
                    }
            );
        }
        let file = dir.join("seabed.asc");
        std::fs::write(&file, text).expect("written");
        SimplifyArgs {
            file,
            method,
            keep: 100,
            out: dir.join("kept.csv"),
            sonar: Some(DVec3::new(0.0, -30.0, 0.0)),
            beam_deg: Some(5.0),
            heading_deg: 0.0,
            hold_m: 0.0,
            weights: None,
            inherit_area: false,
            lambert_db: -20.0,
            seed: 1,
        }
    }

    #[test]
    fn every_method_writes_points_that_a_scene_reads() {
        let dir = tempfile::tempdir().expect("dir");
        for method in MethodArg::value_variants() {
            let args = args(dir.path(), *method);
            main(&args).expect("simplified");
            let bytes = std::fs::read(&args.out).expect("read");
            let points = echotank_scene::points::parse(&bytes).expect("points");
            let wanted = match method {
                MethodArg::AcousticUnbiased => 60..140,
                _ => 100..101,
            };
            assert!(
                wanted.contains(&points.len()),
                "{method:?}: {}",
                points.len()
            );
        }
    }

    #[test]
    fn energies_need_a_sonar_and_bad_files_are_refused() {
        let dir = tempfile::tempdir().expect("dir");
        let blind = SimplifyArgs {
            sonar: None,
            ..args(dir.path(), MethodArg::Acoustic)
        };
        assert!(
            matches!(main(&blind), Err(Failure::Configuration(text)) if text.contains("--sonar"))
        );
        let absent = SimplifyArgs {
            file: dir.path().join("none.asc"),
            ..args(dir.path(), MethodArg::Conventional)
        };
        assert!(
            matches!(main(&absent), Err(Failure::Configuration(text)) if text.contains("none.asc"))
        );
        assert!(parse_weights("1,2,3").is_err() && parse_weights("1,2,3,-1").is_err());
    }
}
