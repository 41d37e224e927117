//! One platform state, read back from every family within its resolution and with its sign.

use echotank_config::spec::{JsfChannels, JsfFormat};
use echotank_core::ping::{PingPlan, SensorState};
use echotank_core::time::UtcNs;
use echotank_emit::jsf::JsfEmitter;
use echotank_emit::sevenk::{RecordSet, SevenKEmitter};
use echotank_protocols::jsf::{
    Dvl2080, PitchRoll2020, Situation2091, SonarData80, message_type as jsf_type,
};
use echotank_protocols::sevenk::Record;
use echotank_protocols::sevenk::records::{
    Attitude1016, Heading1013, Navigation1015, Position1003, RollPitchHeave1012,
};
use echotank_protocols::xtf::{Attitude, FileHeader, Ping};
use glam::DVec3;

use super::rig::*;
use echotank_testing::wire::*;

/// Values read back from a family: degrees, metres, knots; `None` for values that the family does not carry.
struct Said {
    family: &'static str,
    latitude: Option<f64>,
    longitude: Option<f64>,
    /// Positive port up.
    roll: Option<f64>,
    /// Positive bow up.
    pitch: Option<f64>,
    heading: Option<f64>,
    /// Positive down.
    heave: Option<f64>,
    /// Half of the last digit of latitude and longitude, of angles, and of heave.
    steps: [f64; 3],
}

fn state(latitude_deg: f64, longitude_deg: f64, tilt: f64) -> PingPlan {
    let mut plan = plan(3, 6);
    let nav = &mut plan.nav;
    nav.roll_rad = (5.0 * tilt).to_radians();
    nav.pitch_rad = (3.0 * tilt).to_radians();
    nav.heading_rad = 359.9_f64.to_radians();
    nav.heave_down_m = -0.25 * tilt;
    nav.latitude_rad = latitude_deg.to_radians();
    nav.longitude_rad = longitude_deg.to_radians();
    nav.pose.velocity_m_per_s = DVec3::new(2.0, -1.0, 0.0);
    plan.sensor = SensorState {
        latitude_rad: nav.latitude_rad,
        longitude_rad: nav.longitude_rad,
        depth_m: 13.25,
        altitude_m: Some(17.5),
        still_depth_m: None,
    };
    plan
}

fn sevenk(plan: &PingPlan) -> Vec<Said> {
    let mut emitter = SevenKEmitter::new(sheet(), 1);
    let mut records = Vec::new();
    let wanted = RecordSet::of(&[1003, 1012, 1013, 1015, 1016]);
    emitter.emit_ping(plan, &output(6), wanted, &mut records);
    let body = |id: u32| {
        let found = records.iter().find(|r| r.record_type == id).expect("sent");
        Record::parse(&found.bytes).expect("whole").body().to_vec()
    };
    let f = |v: f32| Some(f64::from(v));
    let deg = |v: f32| Some(f64::from(v).to_degrees());
    let none = || Said {
        family: "",
        latitude: None,
        longitude: None,
        roll: None,
        pitch: None,
        heading: None,
        heave: None,
        // Radians as f64, angles and metres as f32.
        steps: [1e-12, 2e-5, 1e-6],
    };
    let bytes = (body(1003), body(1012), body(1013), body(1015), body(1016));
    let position = Position1003::parse(&bytes.0).expect("1003");
    let tilt = RollPitchHeave1012::parse(&bytes.1).expect("1012");
    let heading = Heading1013::parse(&bytes.2).expect("1013");
    let navigation = Navigation1015::parse(&bytes.3).expect("1015");
    let attitude = Attitude1016::parse(&bytes.4).expect("1016");
    let set = attitude.sets().next().expect("a reading");
    assert!((f64::from(navigation.speed_over_ground_m_per_s) - 5.0_f64.sqrt()).abs() < 1e-6);
    let course = f64::from(navigation.course_over_ground_rad).to_degrees();
    assert!((course - 333.434_949).abs() < 1e-4, "{course}");
    vec![
        Said {
            family: "7k 1003",
            latitude: Some(position.latitude_rad_or_northing_m.to_degrees()),
            longitude: Some(position.longitude_rad_or_easting_m.to_degrees()),
            ..none()
        },
        Said {
            family: "7k 1012",
            roll: deg(tilt.roll_rad),
            pitch: deg(tilt.pitch_rad),
            heave: f(-tilt.heave_up_m),
            ..none()
        },
        Said {
            family: "7k 1013",
            heading: deg(heading.heading_rad),
            ..none()
        },
        Said {
            family: "7k 1015",
            latitude: Some(navigation.latitude_rad.to_degrees()),
            longitude: Some(navigation.longitude_rad.to_degrees()),
            heading: deg(navigation.heading_rad),
            ..none()
        },
        Said {
            family: "7k 1016",
            roll: deg(set.roll_rad),
            pitch: deg(set.pitch_rad),
            heading: deg(set.heading_rad),
            heave: f(-set.heave_up_m),
            ..none()
        },
    ]
}

fn jsf(plan: &PingPlan) -> Vec<Said> {
    let messages = jsf_ping(JsfChannels::Sides, JsfFormat::Envelope, plan, &output(6));
    let of = |kind: u16| {
        let found = messages
            .iter()
            .find(|m| m.record_type & 0xFFFF == u32::from(kind));
        jsf_message(found.expect("sent")).body
    };
    let data = SonarData80::parse(of(jsf_type::SONAR_DATA)).expect("80");
    let (latitude, longitude) = data.header.position_rad().expect("a position");
    let (pitch, roll) = data.header.pitch_roll_rad().expect("pitch and roll");
    let tilt = PitchRoll2020::parse(of(jsf_type::PITCH_ROLL)).expect("2020");
    let all = Situation2091::parse(of(jsf_type::SITUATION)).expect("2091");
    let counts = |v: i16| Some(f64::from(v) * 180.0 / 32_768.0);
    let text = of(jsf_type::NMEA);
    let sentence = String::from_utf8(text[12..].to_vec()).expect("text");
    assert!(sentence.starts_with("$GPRMC,"), "{sentence}");
    let fields: Vec<&str> = sentence.split(',').collect();
    let angle = |text: &str, degrees: usize, hemisphere: &str| {
        let value = text[..degrees].parse::<f64>().expect("degrees")
            + text[degrees..].parse::<f64>().expect("minutes") / 60.0;
        Some(if matches!(hemisphere, "S" | "W") {
            -value
        } else {
            value
        })
    };
    vec![
        Said {
            family: "jsf 80",
            latitude: Some(latitude.to_degrees()),
            longitude: Some(longitude.to_degrees()),
            roll: Some(roll.to_degrees()),
            pitch: Some(pitch.to_degrees()),
            heading: data.header.heading_rad().map(f64::to_degrees),
            heave: None,
            // 1e-4 minutes of arc; 180/32768 and 0.01 degrees.
            steps: [0.5e-4 / 60.0, 0.0051, 0.0],
        },
        Said {
            family: "jsf 2002",
            latitude: angle(fields[3], 2, fields[4]),
            longitude: angle(fields[5], 3, fields[6]),
            roll: None,
            pitch: None,
            heading: None,
            heave: None,
            steps: [0.51e-5 / 60.0, 0.0, 0.0],
        },
        Said {
            family: "jsf 2020",
            latitude: None,
            longitude: None,
            roll: counts(tilt.roll),
            pitch: counts(tilt.pitch),
            heading: Some(f64::from(tilt.heading_cdeg) / 100.0),
            heave: Some(f64::from(tilt.heave_down_mm) * 1e-3),
            steps: [0.0, 0.0051, 0.5e-3],
        },
        Said {
            family: "jsf 2091",
            latitude: Some(all.latitude_deg),
            longitude: Some(all.longitude_deg),
            roll: Some(all.roll_deg.into()),
            pitch: Some(all.pitch_deg.into()),
            heading: Some(all.heading_deg.into()),
            heave: Some(all.heave_down_m.into()),
            steps: [1e-12, 2e-5, 1e-6],
        },
    ]
}

fn xtf(plan: &PingPlan) -> Vec<Said> {
    let mut emitter = xtf_emitter(&sonar());
    let head = emitter.file_head();
    let file = FileHeader::parse(&head).expect("a header");
    let mut packets = Vec::new();
    assert_eq!(emitter.emit_ping(plan, &output(6), &mut packets), 0);
    let attitude = Attitude::parse(&packets).expect("an attitude first");
    let ping = Ping::parse(&packets[64..], &file).expect("then the ping");
    let h = &ping.header;
    vec![
        Said {
            family: "xtf 3",
            latitude: None,
            longitude: None,
            roll: Some(attitude.roll_deg.into()),
            pitch: Some(attitude.pitch_deg.into()),
            heading: Some(attitude.heading_deg.into()),
            heave: Some(f64::from(-attitude.heave_up_m)),
            steps: [0.0, 2e-5, 1e-6],
        },
        Said {
            family: "xtf 0",
            latitude: Some(h.sensor_y),
            longitude: Some(h.sensor_x),
            roll: Some(h.sensor_roll_deg.into()),
            pitch: Some(h.sensor_pitch_deg.into()),
            heading: Some(h.sensor_heading_deg.into()),
            heave: Some(f64::from(-h.heave_up_m)),
            steps: [1e-12, 2e-5, 1e-6],
        },
    ]
}

#[test]
fn every_family_carries_the_platforms_state_within_its_resolution_and_sign() {
    let mut seen = 0;
    for (latitude, longitude, tilt) in [
        (54.4, 10.3, 1.0),
        (-36.8, -121.8, 1.0),
        (-33.25, 151.5, -1.0),
        (40.125, -179.999, -1.0),
    ] {
        let plan = state(latitude, longitude, tilt);
        for said in sevenk(&plan)
            .into_iter()
            .chain(jsf(&plan))
            .chain(xtf(&plan))
        {
            let [place, angle, metres] = said.steps;
            for (what, got, want, step) in [
                ("latitude", said.latitude, latitude, place),
                ("longitude", said.longitude, longitude, place),
                ("roll", said.roll, 5.0 * tilt, angle),
                ("pitch", said.pitch, 3.0 * tilt, angle),
                ("heading", said.heading, 359.9, angle),
                ("heave down", said.heave, -0.25 * tilt, metres),
            ] {
                let Some(got) = got else { continue };
                seen += 1;
                assert!(
                    (got - want).abs() <= step,
                    "{} {what}: got {got}, want {want} to {step:e}",
                    said.family
                );
            }
        }
    }
    assert_eq!(seen, 4 * 40, "statements looked at");
}

#[test]
fn depth_and_altitude_are_those_of_the_sensor() {
    let mut plan = state(54.4, 10.3, 1.0);
    // The ship's reference point lies 0.4 m deep, 10 m from the sensor.
    plan.nav.height_m = -0.4;
    plan.sensor.latitude_rad += 10.0 / 6_371_000.0;
    for altitude_m in [Some(17.5), None] {
        plan.sensor.altitude_m = altitude_m;
        let messages = jsf_ping(JsfChannels::Sides, JsfFormat::Envelope, &plan, &output(6));
        let of = |kind: u16| {
            let kind = u32::from(kind);
            let found = messages.iter().find(|m| m.record_type & 0xFFFF == kind);
            jsf_message(found.expect("sent")).body
        };
        let header = SonarData80::parse(of(jsf_type::SONAR_DATA))
            .expect("80")
            .header;
        assert_eq!(
            (header.depth_m(), header.altitude_m()),
            (Some(13.25), altitude_m)
        );
        let all = Situation2091::parse(of(jsf_type::SITUATION)).expect("2091");
        let altitude = altitude_m.unwrap_or(0.0);
        assert_eq!((all.depth_m, f64::from(all.altitude_m)), (13.25, altitude));
        assert_eq!(all.validity >> 4 & 1, u32::from(altitude_m.is_some()));
        let dvl = Dvl2080::parse(of(jsf_type::DVL)).expect("2080");
        assert_eq!(dvl.depth_dm, 133);
        assert_eq!(dvl.distance_cm, [(altitude * 100.0) as i32; 4]);

        let mut emitter = xtf_emitter(&sonar());
        let file = FileHeader::parse(&emitter.file_head()).expect("a header");
        let mut packets = Vec::new();
        emitter.emit_ping(&plan, &output(6), &mut packets);
        let h = Ping::parse(&packets[64..], &file).expect("a ping").header;
        assert_eq!(
            (h.sensor_depth_m, f64::from(h.sensor_altitude_m)),
            (13.25, altitude)
        );
        assert_eq!(
            (h.ship_y, h.sensor_y),
            (54.4, plan.sensor.latitude_rad.to_degrees())
        );
    }
}

#[test]
fn jsf_sends_the_position_sentence_once_a_second() {
    let filter = Box::new(|_: &PingPlan, _: &mut [num_complex::Complex64]| {});
    let sheet = jsf_sheet(JsfChannels::Sides, JsfFormat::Envelope);
    let mut emitter = JsfEmitter::new(sheet, filter);
    let mut plan = state(54.4, 10.3, 1.0);
    let start = UtcNs(plan.stamp_utc.0.div_euclid(1_000_000_000) * 1_000_000_000);
    // Ten seconds with four pings each. A reader that takes every sentence for a fix finds ten fixes.
    let mut sentences = 0;
    for ping in 0..40 {
        plan.stamp_utc = start.plus_s(0.25 * f64::from(ping));
        let mut messages = Vec::new();
        emitter.emit_ping(&plan, &output(6), |_, _| true, &mut messages);
        let of = |kind: u16| {
            let kind = u32::from(kind);
            messages
                .iter()
                .filter(|m| m.record_type & 0xFFFF == kind)
                .count()
        };
        assert_eq!((of(jsf_type::SONAR_DATA), of(jsf_type::PITCH_ROLL)), (2, 1));
        assert_eq!(
            of(jsf_type::NMEA),
            usize::from(ping % 4 == 0),
            "ping {ping}"
        );
        sentences += of(jsf_type::NMEA);
    }
    assert_eq!(sentences, 10);
}
