//! Pictures of a replay and their masks, as configured in `[sonar.picture]`.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use glam::DVec3;

use crate::formats::Formats;
use crate::io::record::masks::MaskRecorder;
use crate::io::record::picture::{write_masks, write_mosaic, write_picture};
use crate::io::record::png::write_waterfall;
use crate::io::record::{RecordError, make_folder};
use echotank_config::spec::{Contrast, PictureRange, SonarSpec};
use echotank_core::frames::angles_from_rotation;
use echotank_core::ping::{Line, LineTruth, PingPlan, Side};
use echotank_core::scene::Target;
use echotank_imaging::image::line::{Projection, RangeAxis, first_return_m};
use echotank_imaging::image::masks::WaterfallMasks;
use echotank_imaging::image::mosaic::{MosaicBuilder, MosaicError, MosaicSpec, SonarPose};
use echotank_imaging::image::water_column::{Stack, polar, polar_masks};
use echotank_imaging::image::waterfall::{Waterfall, WaterfallSpec, rows_that_keep_the_aspect};
use echotank_ping::fan_truth::fan_truth;
use echotank_ping::line_truth::line_truths;
use echotank_ping::rig::{PingSlot, Rig};
use echotank_synthesis::array::fill_gains;

/// Default number of columns per side of a waterfall; both sides fit a screen.
const WATERFALL_COLUMNS: f64 = 600.0;

/// Largest low and smallest high percentile of a mosaic's contrast, as fractions.
const MAP_SHARES: (f64, f64) = (0.02, 0.999);

/// Pictures of one sonar.
pub(crate) struct Pictures {
    spec: SonarSpec,
    folder: PathBuf,
    formats: Formats,
    waterfall: Option<(Waterfall, Option<WaterfallMasks>)>,
    mosaic: Option<MosaicBuilder>,
    stack: Option<Stack>,
    masks: Option<MaskRecorder>,
    fan_masks: Option<MaskRecorder>,
    /// Paths of the fan pictures and their masks.
    written: Vec<PathBuf>,
    gains: Vec<f64>,
    /// Altitude from the newest detected first return.
    last_return_m: Option<f64>,
}

impl Pictures {
    pub(crate) fn create(
        spec: &SonarSpec,
        folder: &Path,
        formats: Formats,
    ) -> Result<Self, RecordError> {
        make_folder(folder)?;
        let lined = !spec.beams.lines.is_empty();
        Ok(Self {
            masks: match formats.masks && lined {
                true => Some(MaskRecorder::of_lines(folder)?),
                false => None,
            },
            fan_masks: match formats.masks && spec.beams.fan.is_some() {
                true => Some(MaskRecorder::of_beams(folder)?),
                false => None,
            },
            spec: spec.clone(),
            folder: folder.to_owned(),
            formats,
            waterfall: None,
            mosaic: None,
            stack: None,
            written: Vec::new(),
            gains: Vec::new(),
            last_return_m: None,
        })
    }

    /// Adds the ping in `slot`, which `rig` has just computed. Returns the truths of its side-scan lines and of its beams if masks are written.
    pub(crate) fn push(
        &mut self,
        slot: &PingSlot,
        rig: &Rig,
    ) -> Result<(Vec<LineTruth>, Vec<LineTruth>), RecordError> {
        let beams = self.fan(slot, rig)?;
        Ok((self.lines(slot, rig)?, beams))
    }

    fn lines(&mut self, slot: &PingSlot, rig: &Rig) -> Result<Vec<LineTruth>, RecordError> {
        let Formats {
            png, mosaic, masks, ..
        } = self.formats;
        if slot.output.lines.is_empty() || !(png || mosaic || masks) {
            return Ok(Vec::new());
        }
        let truths = match masks {
            true => line_truths(rig, slot),
            false => Vec::new(),
        };
        let plan = &slot.plan;
        if let Some(recorder) = &mut self.masks {
            recorder.push(plan.ping_number, &truths)?;
        }
        // Each pulse of a ping has its own side-scan lines, ordered by transmit time.
        let more = &slot.output.more_lines;
        let mut pulses: Vec<(f64, Cow<[Line]>)> = vec![(0.0, (&slot.output.lines[..]).into())];
        pulses.extend(more.iter().map(|m| (m.delay_s, (&m.lines[..]).into())));
        if self.spec.picture.raw {
            for (_, lines) in &mut pulses {
                *lines = self.raw(plan, lines).into();
            }
        }
        let own = pulses[0].1.clone();
        pulses.sort_by(|a, b| a.0.total_cmp(&b.0));
        let arms = self.arms(plan);
        let altitude_m = (rig.scene)
            .seabed_down_m(arms.middle_m.x, arms.middle_m.y)
            .map(|down_m| down_m - arms.middle_m.z)
            .filter(|altitude_m| *altitude_m > 0.0);
        if png {
            let projection = self.projection(plan, &slot.output.lines, altitude_m);
            let (waterfall, labels) = self.waterfall.get_or_insert_with(|| {
                let waterfall = blank_waterfall(&self.spec, plan);
                let rate_hz = self.spec.receiver.sample_rate_hz;
                let labels = masks.then(|| WaterfallMasks::of(&waterfall, rate_hz));
                (waterfall, labels)
            });
            // The picture counts each pulse as a ping.
            let mut row = plan.clone();
            for (number, (_, lines)) in (0..).zip(&pulses) {
                if pulses.len() > 1 {
                    let count = pulses.len() as u32;
                    row.ping_number = plan.ping_number.wrapping_mul(count).wrapping_add(number);
                }
                waterfall.push_with(&row, lines, projection);
                if let Some(labels) = labels {
                    labels.push(&row, &truths, projection);
                }
            }
        }
        if mosaic {
            self.add_to_mosaic(rig, plan, &arms, altitude_m, &own, &truths);
        }
        Ok(truths)
    }

    fn fan(&mut self, slot: &PingSlot, rig: &Rig) -> Result<Vec<LineTruth>, RecordError> {
        let (plan, output) = (&slot.plan, &slot.output);
        let Formats { fan, masks, .. } = self.formats;
        let Some(beams) = output.beams.first().filter(|_| fan || masks) else {
            return Ok(Vec::new());
        };
        let truths = match masks {
            true => fan_truth(rig, slot),
            false => Vec::new(),
        };
        if let Some(recorder) = &mut self.fan_masks {
            recorder.push(plan.ping_number, &truths)?;
        }
        if !fan {
            return Ok(truths);
        }
        let rate_hz = self.spec.receiver.sample_rate_hz;
        let contrast = self.spec.picture.contrast;
        let first = self.stack.is_none();
        let range_m = self.spec.settings.range_m;
        let max_pings = WaterfallSpec::default().max_pings;
        self.stack
            .get_or_insert_with(|| Stack::new(range_m, rate_hz, max_pings))
            .push(plan, beams, &truths);
        if first || plan.ping_number % self.spec.picture.fan_every_pings == 0 {
            let picture = polar(plan, beams, &output.soundings, rate_hz, contrast);
            let stem = format!("fan_{:06}", plan.ping_number);
            let path = self.folder.join(format!("{stem}.png"));
            write_picture(&path, &picture)?;
            self.written.push(path);
            if !truths.is_empty() {
                let (size, masks) = polar_masks(plan, beams, &truths, rate_hz);
                let (folder, masks) = (&self.folder, masks.iter().copied());
                let names = target_names(rig.targets());
                (self.written).extend(write_masks(folder, &stem, size, masks, &names)?);
            }
        }
        Ok(truths)
    }

    /// Side-scan lines without the time-varying gain, at the middle of the pulse.
    fn raw(&mut self, plan: &PingPlan, lines: &[Line]) -> Vec<Line> {
        let rate_hz = self.spec.receiver.sample_rate_hz;
        let half_pulse = (0.5 * plan.pulse.duration_s * rate_hz).round() as usize;
        let samples = plan.sample_count + half_pulse;
        fill_gains(plan, &self.spec.receiver, samples, &mut self.gains);
        let fixed = 10f64.powf(plan.settings.gain_db / 20.0);
        let first = (plan.first_sample_s * rate_hz).round().max(0.0) as usize;
        let gain = |k: usize| {
            let at = k.saturating_sub(first) + half_pulse;
            self.gains.get(at).map_or(1.0, |gain| gain / fixed) as f32
        };
        let mut raw = lines.to_vec();
        for line in &mut raw {
            for (k, a) in line.amplitude.iter_mut().enumerate() {
                *a /= gain(k);
            }
        }
        raw
    }

    fn projection(
        &mut self,
        plan: &PingPlan,
        lines: &[Line],
        altitude_m: Option<f64>,
    ) -> Option<Projection> {
        let ground = |altitude_m| Projection::Ground { altitude_m };
        match self.spec.picture.range {
            PictureRange::Slant => Some(Projection::Slant),
            PictureRange::Ground => altitude_m.map(ground),
            PictureRange::GroundFirstReturn => {
                let rate_hz = self.spec.receiver.sample_rate_hz;
                let axis = RangeAxis::new(plan.sound_speed_m_per_s, rate_hz);
                self.last_return_m = first_return_m(lines, axis).or(self.last_return_m);
                self.last_return_m.map(ground)
            }
        }
    }

    /// World positions of the transmit arrays of the side-scan lines at the start of the pulse.
    fn arms(&self, plan: &PingPlan) -> Arms {
        let pose = plan.trajectory.pose_at(0.0);
        let mut sides = [None; 2];
        for line in &self.spec.beams.lines {
            let array = &self.spec.receive[line.array];
            let mounting = &self.spec.transmit[array.transmit].mounting;
            let at = pose.point_m(mounting.position_m);
            sides[usize::from(line.side == Side::Starboard)] = Some(at);
        }
        let middle_m = match sides {
            [Some(port), Some(starboard)] => 0.5 * (port + starboard),
            [Some(one), None] | [None, Some(one)] => one,
            [None, None] => pose.position_m,
        };
        Arms {
            middle_m,
            sides_m: sides.map(|s| s.unwrap_or(middle_m)),
        }
    }

    fn add_to_mosaic(
        &mut self,
        rig: &Rig,
        plan: &PingPlan,
        arms: &Arms,
        altitude_m: Option<f64>,
        lines: &[Line],
        truths: &[LineTruth],
    ) {
        let (Some(plane), Some(altitude_m)) = (rig.history.origin(), altitude_m) else {
            return;
        };
        let pose = plan.trajectory.pose_at(0.0);
        let (_, pitch_rad, heading_rad) = angles_from_rotation(pose.world_from_body);
        let (latitude_rad, longitude_rad) = plane.geodetic_rad(arms.middle_m.x, arms.middle_m.y);
        let (sin, cos) = heading_rad.sin_cos();
        let ahead = DVec3::new(cos, sin, 0.0);
        let starboard = DVec3::new(-sin, cos, 0.0);
        let place = SonarPose {
            latitude_rad,
            longitude_rad,
            heading_rad,
            altitude_m,
            pitch_rad,
            drift: pose.velocity_m_per_s.dot(ahead) / plan.sound_speed_m_per_s,
            starboard_m: arms.sides_m.map(|at| (at - arms.middle_m).dot(starboard)),
        };
        let look = self.spec.picture.mosaic;
        let range_m = plan.settings.range_m;
        let builder = self.mosaic.get_or_insert_with(|| {
            MosaicBuilder::new(MosaicSpec {
                metres_per_pixel: look.metres_per_pixel,
                overlap: look.overlap,
                range_m,
                nadir_rad: look.nadir_rad,
                ..MosaicSpec::default()
            })
        });
        let axis = RangeAxis::new(plan.sound_speed_m_per_s, self.spec.receiver.sample_rate_hz);
        builder.push_labelled(&place, axis, lines, truths);
    }

    /// Writes the accumulated pictures and returns the paths of all files.
    pub(crate) fn finish(self, targets: &[Target]) -> Result<Vec<PathBuf>, RecordError> {
        let names = target_names(targets);
        let look = &self.spec.picture;
        let mut written = self.written;
        if let Some(stack) = &self.stack {
            let path = self.folder.join("water_column.png");
            write_picture(&path, &stack.picture(look.contrast))?;
            written.push(path);
            if let Some((size, masks)) = stack.masks() {
                let masks = masks.iter().copied();
                written.extend(write_masks(
                    &self.folder,
                    "water_column",
                    size,
                    masks,
                    &names,
                )?);
            }
        }
        if let Some((waterfall, labels)) = &self.waterfall {
            let path = self.folder.join("waterfall.png");
            if write_waterfall(&path, waterfall)? {
                written.push(path);
                if let Some(labels) = labels {
                    let size = (labels.width(), labels.height());
                    let masks: Vec<_> = labels.pixels().collect();
                    let masks = masks.iter().copied();
                    written.extend(write_masks(&self.folder, "waterfall", size, masks, &names)?);
                }
            }
        }
        if let Some(builder) = self.mosaic {
            let tiff = self.folder.join("mosaic.tif");
            let png = self.folder.join("mosaic.png");
            let mosaic = builder.finish().map_err(|e| RecordError::Io {
                path: tiff.clone(),
                action: "make",
                source: match e {
                    MosaicError::Io(e) => e,
                    other => std::io::Error::other(other),
                },
            })?;
            // A map has no water column that must stay dark.
            let contrast = match look.contrast {
                Contrast::Percentiles { low, high } => Contrast::Percentiles {
                    low: low.min(MAP_SHARES.0),
                    high: high.min(MAP_SHARES.1),
                },
                fixed => fixed,
            };
            if write_mosaic(&tiff, &png, &mosaic, look.colours, contrast)? {
                written.extend([tiff, png]);
                if !mosaic.masks.is_empty() {
                    let size = (mosaic.width, mosaic.height);
                    let masks = mosaic.masks.iter().copied();
                    written.extend(write_masks(&self.folder, "mosaic", size, masks, &names)?);
                }
            }
        }
        for masks in [self.masks, self.fan_masks].into_iter().flatten() {
            written.extend(masks.finish()?);
        }
        Ok(written)
    }
}

fn target_names(targets: &[Target]) -> Vec<String> {
    targets.iter().map(|t| t.name.clone()).collect()
}

/// World positions of the transmit arrays, metres.
struct Arms {
    middle_m: DVec3,
    /// Positions for port and starboard.
    sides_m: [DVec3; 2],
}

fn blank_waterfall(spec: &SonarSpec, plan: &PingPlan) -> Waterfall {
    let look = &spec.picture;
    let range_m = plan.settings.range_m;
    let metres_per_pixel = look.metres_per_pixel.unwrap_or(range_m / WATERFALL_COLUMNS);
    let pulses = (1 + spec.more_pulses.len()) as f64;
    let advance_m =
        plan.nav.pose.velocity_m_per_s.truncate().length() / (plan.ping_rate_hz * pulses);
    let picture = WaterfallSpec {
        range_m,
        metres_per_pixel,
        rows_per_ping: rows_that_keep_the_aspect(advance_m, metres_per_pixel),
        scale: look.contrast,
        colours: look.colours,
        normalise_range: look.flatten,
        ..WaterfallSpec::default()
    };
    Waterfall::new(picture, spec.receiver.sample_rate_hz)
}
