//! The one checked path by which anything changes the sonar.
