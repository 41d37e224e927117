//! The line-array engine compared with the direct sum and with the slow reference.

mod alone;
mod models;
mod moving;
#[path = "../echo_model/rig.rs"]
#[allow(dead_code, reason = "shared with the tests of the echo model")]
mod rig;
mod scene;
mod still;
mod tolerance;
