//! Teledyne RESON 7k records of a ping, and the session of one client.
