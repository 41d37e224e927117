//! Summary of navigation transforms and outputs.

use std::fmt;

use glam::DVec3;

use super::{SIGN_TEST_DEG, line, tilted};
use crate::spec::{
    NavChannel, NavSourceSpec, NavSpec, NavTargetSpec, OnLost, PulseSpec, VerticalSpec,
};
use echotank_core::frames::{angles_from_rotation, rotation_from_angles};

/// Mounting of a motion sensor, and its measurements when the platform tilts. These reveal a wrong sign.
pub(crate) fn write_mounting(out: &mut String, source: &NavSourceSpec) -> fmt::Result {
    let sensor = &source.mounting;
    if sensor.heave_arm_m != DVec3::ZERO {
        let text = format!(
            "{}: heave is measured {}; its lift by roll and pitch is subtracted",
            source.name,
            tilted(sensor.heave_arm_m)
        );
        line(out, "  signs", &text)?;
    }
    if sensor.angles_rad == DVec3::ZERO {
        return Ok(());
    }
    let a = sensor.angles_rad;
    let body_from_sensor = rotation_from_angles(a.x, a.y, a.z);
    let tilt_rad = SIGN_TEST_DEG.to_radians();
    let says = |roll_rad: f64, pitch_rad: f64| {
        let sensor = rotation_from_angles(roll_rad, pitch_rad, 0.0) * body_from_sensor;
        let (roll, pitch, _) = angles_from_rotation(sensor);
        format!(
            "measures roll {:+.3}, pitch {:+.3}",
            roll.to_degrees(),
            pitch.to_degrees()
        )
    };
    let text = format!(
        "{}: on a level platform {}, heading error {:+.3}; at roll +{SIGN_TEST_DEG} deg (starboard down) {}; at pitch +{SIGN_TEST_DEG} deg (bow up) {}",
        source.name,
        says(0.0, 0.0),
        a.z.to_degrees(),
        says(tilt_rad, 0.0),
        says(0.0, tilt_rad)
    );
    line(out, "  signs", &text)
}

/// Summary of depth, towing, failover and output sentences.
pub(crate) fn write_rest(out: &mut String, nav: &NavSpec) -> fmt::Result {
    let given = |channel| nav.sources.iter().any(|s| s.provides.contains(&channel));
    let given_for_sure = |channel| {
        let mut sources = nav.sources.iter();
        sources.any(|s| s.provides.contains(&channel) && !s.detect)
    };
    let down = match nav.vertical {
        VerticalSpec::Waterline { reference_down_m } if given_for_sure(NavChannel::Heave) => {
            format!("{reference_down_m} m below the waterline, plus heave")
        }
        VerticalSpec::Waterline { reference_down_m } if given(NavChannel::Heave) => {
            format!("{reference_down_m} m below the waterline, plus heave where a source gives it")
        }
        VerticalSpec::Waterline { reference_down_m } => {
            format!("{reference_down_m} m below the waterline")
        }
        VerticalSpec::Gnss { datum_offset_m } => format!(
            "minus the antenna's height plus {datum_offset_m} m, corrected for the lever arm; heave is not added, because the height includes it"
        ),
        VerticalSpec::Depth if given(NavChannel::Depth) => {
            "from the depth sensor, corrected for the lever arm; heave is not added, because the depth includes it".to_owned()
        }
        VerticalSpec::Depth => "from the track; heave is not added".to_owned(),
    };
    let down = match nav.heave_from_depth_m {
        Some(depth_m) => {
            format!("{down}; the records state its displacement from {depth_m} m as heave")
        }
        None => down,
    };
    line(out, "depth", &format!("of the reference point: {down}"))?;
    if let Some(tow) = &nav.tow {
        let straight_m = tow.cable_out_m * tow.cable_scope;
        let at = |depth_m: f64| {
            (straight_m * straight_m - depth_m * depth_m)
                .max(0.0)
                .sqrt()
        };
        let text = format!(
            "{:.1} m of cable from {:.2} m forward, {:.2} starboard of the ship's reference point; {:.1} m behind that point at the depth where the cable begins, {:.1} m when {:.1} m below it",
            tow.cable_out_m,
            tow.point_m.x,
            tow.point_m.y,
            at(0.0),
            at(straight_m / 2.0),
            straight_m / 2.0
        );
        line(out, "tow", &text)?;
    }
    if nav.mode == crate::spec::NavMode::Predict {
        let becomes = match nav.on_lost {
            OnLost::Hold => "pings go on with the last known motion come to rest, flagged invalid",
            OnLost::Skip => "pings are skipped",
        };
        let text = format!(
            "after {:.0} ms without a measurement {becomes}",
            nav.max_extrapolation_s * 1e3
        );
        line(out, "silence", &text)?;
    }
    for output in &nav.outputs {
        let target = match &output.target {
            NavTargetSpec::Udp { to } => format!("UDP {to}"),
            NavTargetSpec::TcpListen { listen } => format!("TCP clients on {listen}"),
            NavTargetSpec::Serial { port, baud, line } => {
                format!("{port} at {baud} Bd {}", line.name())
            }
        };
        let pulse = match output.pulse {
            PulseSpec::None => "",
            PulseSpec::Rts => ", RTS at each second ahead of its ZDA",
            PulseSpec::Dtr => ", DTR at each second ahead of its ZDA",
            PulseSpec::Byte => ", byte 0x07 at each second ahead of its ZDA",
        };
        let names: Vec<String> = output
            .sentences
            .iter()
            .map(|s| format!("{}{}", output.talker, s.name()))
            .collect();
        let text = format!(
            "{}: {} to {target}, {} a second{pulse}",
            output.name,
            names.join(" "),
            output.rate_hz
        );
        line(out, "nav out", &text)?;
    }
    Ok(())
}
