//! Describes a sonar and one ping's plan as JSON: SI units, radians, north-east-down.

use glam::{DQuat, DVec3};
use serde_json::{Value, json};

use echotank_config::spec::SonarSpec;
use echotank_core::arrays::{Mounting, Pattern, Receiver, ReceiverFilter, TimeVaryingGain};
use echotank_core::ping::{PingPlan, Segment, Side};
use echotank_core::pulse::{Pulse, PulseKind};

/// Properties common to all pings of fixed settings, from the plan of one ping.
pub(crate) fn sonar_and_plan(sonar: &SonarSpec, plan: &PingPlan) -> Value {
    json!({
        "sonar": sonar.name,
        "serial": sonar.serial,
        "plan": plan_summary(plan),
        "receiver": receiver(&sonar.receiver),
        "transmit": sonar.transmit.iter().zip(&sonar.transmit_names).map(|(t, name)| json!({
            "name": name,
            "mounting": mounting(&t.mounting),
            "pattern": pattern(&t.pattern),
            "level_offset_db": t.level_offset_db,
        })).collect::<Vec<_>>(),
        "receive": sonar.receive.iter().zip(&sonar.receive_names).map(|(r, name)| {
            let mut array = json!({
                "name": name,
                "mounting": mounting(&r.mounting),
                "elements": r.elements,
                "spacing_m": r.spacing_m,
                "element_pattern": pattern(&r.element_pattern),
                "sensitivity_db": r.sensitivity_db,
                "transmit": r.transmit,
            });
            if let Some(radius_m) = r.radius_m {
                array["radius_m"] = json!(radius_m);
            }
            array
        }).collect::<Vec<_>>(),
        "lines": sonar.beams.lines.iter().map(|l| json!({
            "side": side(l.side),
            "array": l.array,
        })).collect::<Vec<_>>(),
        "fan": sonar.beams.fan.as_ref().map(|f| json!({
            "array": f.array,
            "beams": f.beams,
            "sector_rad": f.sector_rad,
            "shading": f.shading.name(),
            "former": f.form.former.name(),
            "spacing": f.form.spacing.name(),
            "center_rad": f.form.center_rad,
            "roll_stabilised": f.form.roll_stabilised,
        })),
    })
}

/// Settings, pulse, model and window of one ping.
pub(super) fn plan_summary(plan: &PingPlan) -> Value {
    let s = &plan.settings;
    json!({
        "settings": {
            "range_m": s.range_m,
            "max_ping_rate_hz": s.max_ping_rate_hz,
            "source_level_db": s.source_level_db,
            "gain_db": s.gain_db,
            "pulse_duration_s": s.pulse_duration_s,
        },
        "ping_rate_hz": plan.ping_rate_hz,
        "ping_period_s": plan.ping_period_s,
        "pulse": pulse(&plan.pulse),
        "sound_speed_m_per_s": plan.sound_speed_m_per_s,
        "absorption_db_per_m": plan.absorption_db_per_m,
        "sample_count": plan.sample_count,
        "first_sample_s": plan.first_sample_s,
        "model": {
            "path": plan.model.path.name(),
            "doppler": plan.model.doppler.name(),
            "synthesis": plan.model.synthesis.name(),
            "segment_s": plan.model.segment_s,
            "cull_db": plan.model.cull_db,
        },
    })
}

/// The trajectory samples on which the echoes of a ping were computed.
pub(super) fn segments(segments: &[Segment]) -> Value {
    segments
        .iter()
        .map(|s| {
            json!({
                "start_s": s.start_s,
                "position_m": vector(s.position_m),
                "velocity_m_per_s": vector(s.velocity_m_per_s),
                "world_from_body_xyzw": quaternion(s.world_from_body),
            })
        })
        .collect()
}

pub(super) fn side(side: Side) -> &'static str {
    match side {
        Side::Port => "port",
        Side::Starboard => "starboard",
    }
}

pub(super) fn vector(v: DVec3) -> [f64; 3] {
    v.to_array()
}

fn quaternion(q: DQuat) -> [f64; 4] {
    q.to_array()
}

fn mounting(m: &Mounting) -> Value {
    json!({
        "position_m": vector(m.position_m),
        "body_from_array_xyzw": quaternion(m.body_from_array),
    })
}

fn pattern(p: &Pattern) -> Value {
    match *p {
        Pattern::Omnidirectional => json!("omnidirectional"),
        Pattern::Rectangle {
            length_m,
            width_m,
            baffled,
        }
        | Pattern::Part {
            length_m,
            width_m,
            baffled,
            ..
        } => json!({ "length_m": length_m, "width_m": width_m, "baffled": baffled }),
    }
}

fn pulse(p: &Pulse) -> Value {
    json!({
        "kind": match p.kind {
            PulseKind::LfmUp => "lfm-up",
            PulseKind::LfmDown => "lfm-down",
            PulseKind::Cw => "cw",
        },
        "center_frequency_hz": p.center_frequency_hz,
        "bandwidth_hz": p.bandwidth_hz,
        "duration_s": p.duration_s,
        "taper": p.taper,
    })
}

fn receiver(r: &Receiver) -> Value {
    json!({
        "sample_rate_hz": r.sample_rate_hz,
        "filter": match r.filter {
            ReceiverFilter::None => "none",
            ReceiverFilter::Fir => "fir",
        },
        "tvg": match &r.tvg {
            TimeVaryingGain::None => json!("none"),
            TimeVaryingGain::Law { spreading, absorption_db_per_m, max_db } => json!({
                "spreading": spreading,
                "absorption_db_per_m": absorption_db_per_m,
                "max_db": max_db,
            }),
            TimeVaryingGain::Table(points) => json!(points),
        },
        "noise_db": r.noise_db,
        "adc_bits": r.adc_bits,
        "full_scale_v": r.full_scale_v,
        "seed": r.seed,
    })
}
