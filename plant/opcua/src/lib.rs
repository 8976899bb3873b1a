//! Servers and clients of OPC UA.
