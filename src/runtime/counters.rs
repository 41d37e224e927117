//! Counters of a sonar, for the periodic status, `/metrics` and `replay`.

use std::fmt;
use std::sync::atomic::{AtomicU64, Ordering};

use echotank_core::navigation::NavState;
use echotank_core::ping::{
    EchoCounts, ErrorCheck, MethodMark, OverloadState, PingOutput, SceneCounts,
};
use echotank_ping::method_selection::live::SelectionCounts;
use echotank_ping::rig::SonarUnit;

/// Declares the counters. `all` lists those with a metric: the name and the help text, which also documents the field.
macro_rules! ping_counters {
    (
        metrics { $($vis:vis $field:ident = $metric:literal, $help:literal;)* }
        without_metric { $($(#[$doc:meta])* $plain_vis:vis $plain:ident: $type:ty,)* }
    ) => {
        /// Counters of one sonar, written by the pipeline and the delivery thread.
        #[derive(Debug, Default)]
        pub struct PingCounters {
            $(
                #[doc = concat!($help, ".")]
                $vis $field: AtomicU64,
            )*
            $($(#[$doc])* $plain_vis $plain: $type,)*
        }

        impl PingCounters {
            /// Metric name, help text and value of each counter.
            pub fn all(&self) -> impl Iterator<Item = (&'static str, &'static str, u64)> + '_ {
                [$(($metric, $help, &self.$field)),*]
                    .into_iter()
                    .map(|(name, help, counter)| (name, help, read(counter)))
            }
        }
    };
}

ping_counters! {
    metrics {
        pub made = "pings_made", "Pings computed";
        pub(crate) skipped_nav = "pings_skipped_nav", "Pings whose navigation was incomplete at the deadline";
        pub(crate) skipped_late = "pings_skipped_late", "Pings whose deadline passed before they could be computed";
        pub(crate) skipped_queue = "pings_skipped_queue", "Pings skipped because the queue was full";
        pub degraded = "pings_degraded", "Pings computed with a larger tolerance because of overload";
        pub looser = "looser_now", "Degradation level of the newest ping";
        pub truncated = "pings_truncated", "Pings truncated while streaming because of overload";
        pub stretched = "pings_stretched", "Pings whose pulse was delayed because of overload";
        pub(crate) stretched_us = "stretched_us", "Sum of the delays of pulses because of overload, microseconds";
        pub recordings_stopped = "recordings_stopped", "Recorders that ended with an error";
        pub(crate) triggers_missed = "triggers_missed", "Pulses suppressed by a fault";
        pub(crate) deadline_misses = "deadline_misses", "Pings delivered after their deadline";
        pub(crate) worst_late_us = "worst_late_us", "Largest lateness of a delivery, microseconds";
        pub(crate) drift_us = "drift_us", "Lateness of the newest delivery, which is the drift since the first, microseconds";
        pub(crate) nav_age_ms = "nav_age_ms", "Age of the newest navigation sample of the last ping, milliseconds";
        pub(crate) compute_us = "compute_us", "Time spent computing pings, microseconds";
        pub(crate) worst_compute_us = "worst_compute_us", "Longest computing time of a ping, microseconds";
        pub(crate) samples_saturated = "samples_saturated", "Samples clipped by the converter";
        pub arrivals = "arrivals", "Echo paths summed";
        pub unreached = "scatterers_unreached", "Scatterers of pings that no sound ray reaches";
        pub extrapolated = "pings_extrapolated", "Pings whose navigation was extrapolated";
        pub time_jumped = "pings_time_jumped", "Pings while the clock of a navigation source jumped or was corrected";
        pub checked = "pings_checked", "Pings with an error check";
        pub error_check_faults = "error_check_faults", "Pings whose error check, like the one before, exceeded 1.3 tolerances";
        pub plan = "plan", "Block of pings that the newest ping's methods were selected on, from 1; 0 without a selection";
        pub plans_given_up = "plans_given_up", "Method plans abandoned because an error check exceeded their tolerance";
        pub(crate) plans_failed = "plans_failed", "Method plans that could not be prepared";
        pub above_tolerance = "pings_above_tolerance", "Pings with a predicted error above the tolerance, or with a checked window above 1.3 tolerances";
    }
    without_metric {
        /// Echo paths culled.
        pub culled: AtomicU64,
        /// Pings whose navigation is flagged invalid.
        pub(crate) invalid_nav: AtomicU64,
        /// Predicted error and tolerance of the method plan, as bits of f64.
        pub(crate) plan_promise: [AtomicU64; 2],
        /// Number of elements of a line that the plan computes as one element.
        pub(crate) plan_part_elements: AtomicU64,
        /// Echoes outside the engine's range of distance or speed.
        pub beyond_engine: AtomicU64,
        /// Seabed scatterers generated, summed over pings.
        pub(crate) seabed_made: AtomicU64,
        /// Seabed scatterers culled, summed over pings.
        pub(crate) seabed_culled: AtomicU64,
        /// Seabed scatterers in shadow, summed over pings.
        pub(crate) seabed_shadowed: AtomicU64,
        /// Seabed scatterers used, summed over pings.
        pub(crate) seabed_used: AtomicU64,
        /// Newest error check: error, lower and upper bound, as bits of f64.
        pub error_check: [AtomicU64; 3],
    }
}

/// Adds to a counter, with relaxed ordering.
pub fn add(counter: &AtomicU64, n: u64) {
    counter.fetch_add(n, Ordering::Relaxed);
}

/// Raises a counter to at least `n`, with relaxed ordering.
pub fn worst(counter: &AtomicU64, n: u64) {
    counter.fetch_max(n, Ordering::Relaxed);
}

fn read(counter: &AtomicU64) -> u64 {
    counter.load(Ordering::Relaxed)
}

impl PingCounters {
    /// Counts a computed ping with its computing time `compute_us`, us.
    pub fn ping(&self, counts: &EchoCounts, saturated: u64, compute_us: u64) {
        add(&self.made, 1);
        add(&self.arrivals, counts.used);
        add(&self.culled, counts.culled);
        add(&self.beyond_engine, counts.beyond_engine);
        add(&self.samples_saturated, saturated);
        add(&self.compute_us, compute_us);
        worst(&self.worst_compute_us, compute_us);
    }

    /// Counts the seabed scatterers of a ping.
    pub fn scene(&self, counts: &SceneCounts) {
        add(&self.seabed_made, counts.made);
        add(&self.seabed_culled, counts.culled);
        add(&self.seabed_shadowed, counts.shadowed);
        add(&self.seabed_used, counts.scatterers);
        add(&self.unreached, counts.unreached);
    }

    /// Counts the overload measures of a ping with degradation level `level`.
    pub fn overload_state(&self, level: usize, overload_state: &OverloadState) {
        add(&self.degraded, u64::from(level > 0));
        self.looser.store(level as u64, Ordering::Relaxed);
        add(&self.stretched, u64::from(overload_state.put_off_s > 0.0));
        add(&self.stretched_us, (overload_state.put_off_s * 1e6) as u64);
    }

    /// Counts what a ping says of its error: its error check and its method plan, if it has them.
    pub fn errors_of(&self, output: &PingOutput, unit: &SonarUnit) {
        self.error_check(output.error_check.as_ref());
        let methods = output.methods.as_ref();
        if let Some(method_selector) = &unit.method_selector {
            self.plan(methods, &method_selector.counts);
        }
        // Of pictures the tolerance is not asked of samples.
        let asked = unit.spec.synthesis.image_cells.is_none();
        let predicted = methods.is_some_and(|m| asked && m.predicted_error > m.tolerance);
        let measured = output.error_check.is_some_and(|c| c.exceeded);
        add(&self.above_tolerance, u64::from(predicted || measured));
    }

    fn error_check(&self, error_check: Option<&ErrorCheck>) {
        let Some(c) = error_check else {
            return;
        };
        add(&self.checked, 1);
        add(&self.error_check_faults, u64::from(c.fault));
        for (to, value) in self.error_check.iter().zip([c.error, c.low, c.high]) {
            to.store(value.to_bits(), Ordering::Relaxed);
        }
    }

    fn plan(&self, mark: Option<&MethodMark>, counts: &SelectionCounts) {
        let Some(mark) = mark else {
            return;
        };
        self.plan.store(u64::from(mark.plan), Ordering::Relaxed);
        self.plan_part_elements
            .store(mark.part_elements as u64, Ordering::Relaxed);
        let promise = [mark.predicted_error, mark.tolerance];
        for (to, value) in self.plan_promise.iter().zip(promise) {
            to.store(value.to_bits(), Ordering::Relaxed);
        }
        self.plans_given_up
            .store(counts.given_up, Ordering::Relaxed);
        self.plans_failed.store(counts.failed, Ordering::Relaxed);
    }

    /// Part of the status line on seabed, engine, plan, overload and error checks.
    fn model_text(&self) -> String {
        let mut text = String::new();
        match read(&self.time_jumped) {
            0 => {}
            n => text += &format!(", {n} with a time jump of the navigation"),
        }
        let per_ping = |sum: &AtomicU64| read(sum) / read(&self.made).max(1);
        if read(&self.seabed_used) > 0 {
            text += &format!(
                ", seabed per ping: {} scatterers used, {} culled, {} in shadow, {} generated",
                per_ping(&self.seabed_used),
                per_ping(&self.seabed_culled),
                per_ping(&self.seabed_shadowed),
                per_ping(&self.seabed_made)
            );
        }
        match per_ping(&self.unreached) {
            0 => {}
            n => text += &format!(", {n} scatterers per ping without a sound ray"),
        }
        match read(&self.beyond_engine) {
            0 => {}
            n => {
                text += &format!(
                    ", {n} echoes outside the engine's design limits, made by the direct sum"
                )
            }
        }
        if read(&self.checked) > 0 {
            let [error, low, high] = [0, 1, 2].map(|k| f64::from_bits(read(&self.error_check[k])));
            text += &format!(
                ", {} checked: error {error:.1e} ({low:.1e} to {high:.1e})",
                read(&self.checked)
            );
        }
        if read(&self.plan) > 0 {
            let [error, tolerance] = [0, 1].map(|k| f64::from_bits(read(&self.plan_promise[k])));
            text += &format!(
                ", plan {}{}: {error:.1e} of {tolerance:.1e} predicted",
                read(&self.plan),
                match read(&self.plan_part_elements) > 1 {
                    true => " (lines only)",
                    false => "",
                }
            );
        }
        match read(&self.above_tolerance) {
            0 => {}
            n => text += &format!(", {n} predicted or measured above the tolerance"),
        }
        match (read(&self.degraded), read(&self.looser)) {
            (0, _) => {}
            (n, 0) => {
                text += &format!(", OVERLOAD: {n} computed with a larger tolerance, none now")
            }
            (n, now) => {
                text +=
                    &format!(", OVERLOAD: {n} computed with a larger tolerance, now at level {now}")
            }
        }
        match read(&self.truncated) {
            0 => {}
            n => text += &format!(", OVERLOAD: {n} truncated while streaming"),
        }
        match read(&self.stretched) {
            0 => {}
            n => {
                text += &format!(
                    ", OVERLOAD: {n} pulses delayed, {:.1} s in total",
                    read(&self.stretched_us) as f64 / 1e6
                )
            }
        }
        match (read(&self.plans_given_up), read(&self.plans_failed)) {
            (0, 0) => {}
            (given_up, failed) => {
                text += &format!(
                    ", FAULT: {given_up} method plans abandoned after error checks, {failed} could not be prepared"
                )
            }
        }
        match read(&self.recordings_stopped) {
            0 => {}
            n => text += &format!(", RECORDING STOPPED by an error ({n})"),
        }
        match read(&self.error_check_faults) {
            0 => {}
            n => text += &format!(", FAULT: {n} of them above 1.3 times the tolerance"),
        }
        text
    }

    /// Newest method plan with its error check, as JSON; null without a plan.
    pub(crate) fn methods_json(&self) -> serde_json::Value {
        if read(&self.plan) == 0 {
            return serde_json::Value::Null;
        }
        let [predicted, tolerance] = [0, 1].map(|k| f64::from_bits(read(&self.plan_promise[k])));
        let measured =
            (read(&self.checked) > 0).then(|| f64::from_bits(read(&self.error_check[0])));
        serde_json::json!({
            "plan": read(&self.plan),
            "output": if read(&self.plan_part_elements) > 1 { "beams" } else { "elements" },
            "part_elements": read(&self.plan_part_elements),
            "predicted_error": predicted,
            "tolerance": tolerance,
            "measured_error": measured,
            "margin": measured.map(|error| tolerance / error.max(f64::MIN_POSITIVE)),
            "error_check_faults": read(&self.error_check_faults),
            "given_up": read(&self.plans_given_up),
            "failed": read(&self.plans_failed),
            "above_tolerance": read(&self.above_tolerance),
        })
    }

    /// Counts the navigation state of a ping.
    pub fn nav(&self, state: &NavState) {
        let age_s = state.position_age_s.max(state.attitude_age_s).max(0.0);
        self.nav_age_ms
            .store((age_s * 1e3) as u64, Ordering::Relaxed);
        add(&self.extrapolated, u64::from(state.extrapolated));
        add(&self.invalid_nav, u64::from(state.invalid.any()));
        add(&self.time_jumped, u64::from(state.time_jumped));
    }

    /// Status line of `replay`, which has no clock.
    pub(crate) fn replay_line(&self) -> String {
        format!(
            "{} pings computed, {} skipped (navigation), {} samples saturated{}",
            read(&self.made),
            read(&self.skipped_nav),
            read(&self.samples_saturated),
            self.model_text()
        )
    }

    /// Advice if every ping is skipped.
    pub fn advice(&self, latency_s: f64) -> Option<String> {
        (read(&self.made) == 0 && read(&self.skipped_nav) > 0).then(|| {
            format!(
                "  no ping yet: the navigation did not cover any ping within run.latency_ms = {}. Mode \"settle\" needs two measurements of every quantity after a ping's window: raise run.latency_ms above twice their interval, or set nav.mode = \"predict\"",
                latency_s * 1e3
            )
        })
    }

    /// Like [`Self::all`], for the newest ping's plan and error check; `None` without a value.
    pub fn errors(&self) -> [(&'static str, &'static str, Option<f64>); 4] {
        let of = |bits: &AtomicU64| f64::from_bits(read(bits));
        let planned = read(&self.plan) > 0;
        let checked = read(&self.checked) > 0;
        let [predicted, tolerance] = [0, 1].map(|k| planned.then(|| of(&self.plan_promise[k])));
        let measured = checked.then(|| of(&self.error_check[0]));
        let margin = tolerance.zip(measured);
        [
            (
                "plan_predicted_error",
                "Predicted bound of the relative error of element samples, newest method plan",
                predicted,
            ),
            (
                "plan_tolerance",
                "Tolerance of the newest method plan, relative",
                tolerance,
            ),
            (
                "checked_error",
                "Relative error measured by the newest error check",
                measured,
            ),
            (
                "plan_margin",
                "Tolerance over measured error",
                margin.map(|(tolerance, error)| tolerance / error.max(f64::MIN_POSITIVE)),
            ),
        ]
    }

    /// Number of pings skipped for any reason.
    pub fn skipped(&self) -> u64 {
        read(&self.skipped_nav) + read(&self.skipped_late) + read(&self.skipped_queue)
    }
}

impl fmt::Display for PingCounters {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let made = read(&self.made);
        write!(
            f,
            "pings {made} made, {} skipped (nav {}, late {}, queue {}), {} deadline misses (worst {:.1} ms), compute {:.1} ms mean {:.1} ms worst, nav age {} ms, {} extrapolated, {} on invalid navigation, {} samples saturated{}",
            self.skipped(),
            read(&self.skipped_nav),
            read(&self.skipped_late),
            read(&self.skipped_queue),
            read(&self.deadline_misses),
            read(&self.worst_late_us) as f64 / 1e3,
            read(&self.compute_us) as f64 / 1e3 / made.max(1) as f64,
            read(&self.worst_compute_us) as f64 / 1e3,
            read(&self.nav_age_ms),
            read(&self.extrapolated),
            read(&self.invalid_nav),
            read(&self.samples_saturated),
            self.model_text(),
        )
    }
}
