//! Configurations, navigation inputs and servers, with files and sockets.

mod config_accepts;
mod config_refuses;
mod families;
mod nav_failover;
mod nav_inputs;
mod nav_rates;
mod seats;
mod server;
