//! Publishes a temperature as a small device does: `publisher [ADDRESS [COUNT]]`.
//!
//! The module `device` needs `core` and `alloc` only, so it also works on a microcontroller with
//! `uadp = { version = "0.1", default-features = false }`. The rest is the clock and the socket of
//! this host.

extern crate alloc;

use std::error::Error;
use std::net::UdpSocket;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use uadp::Timestamp;

use device::Sensor;

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let to = arguments.next();
    let to = to.as_deref().unwrap_or("239.192.0.40:4840");
    let count = arguments.next().map_or(Ok(u32::MAX), |text| text.parse())?;
    let socket = UdpSocket::bind("0.0.0.0:0")?;
    let mut sensor = Sensor::default();
    for number in 0..count {
        let celsius = 20.0 + f64::from(number % 10) / 10.0;
        let datagram = sensor.measured(celsius, now()?)?;
        socket.send_to(datagram, to)?;
        #[expect(clippy::disallowed_methods, reason = "the period of the sensor")]
        std::thread::sleep(Duration::from_millis(100));
    }
    Ok(())
}

fn now() -> Result<Timestamp, Box<dyn Error>> {
    #[expect(clippy::disallowed_methods, reason = "the clock of the device")]
    let since = SystemTime::now().duration_since(UNIX_EPOCH)?;
    Ok(Timestamp::from_unix_nanos(i128::try_from(
        since.as_nanos(),
    )?))
}

/// The device: values in, datagrams out.
mod device {
    use alloc::vec::Vec;

    use uadp::{
        DataSetHeader, EncodeError, GroupHeader, NetworkHeader, NetworkMessageEncoder, PublisherId,
        Scalar, Timestamp,
    };

    /// A sensor that publishes `ua_3_5_11`.
    #[derive(Debug, Default)]
    pub(crate) struct Sensor {
        sequence: u16,
        datagram: Vec<u8>,
    }

    impl Sensor {
        /// Returns the datagram of a measured value. The buffer is reused.
        pub(crate) fn measured(
            &mut self,
            celsius: f64,
            now: Timestamp,
        ) -> Result<&[u8], EncodeError> {
            let network = NetworkHeader {
                publisher_id: Some(PublisherId::UInt16(3)),
                group: Some(GroupHeader {
                    writer_group_id: Some(5),
                    ..GroupHeader::default()
                }),
                ..NetworkHeader::default()
            };
            let header = DataSetHeader {
                sequence_number: Some(self.sequence),
                timestamp: Some(now.time),
                ..DataSetHeader::default()
            };
            self.sequence = self.sequence.wrapping_add(1);
            self.datagram.clear();
            let mut message =
                NetworkMessageEncoder::new(&mut self.datagram, &network, Some(&[11]))?;
            let mut fields = message.key_frame(&header)?;
            fields.scalar(Scalar::Double(celsius))?;
            fields.finish()?;
            message.finish()?;
            Ok(&self.datagram)
        }
    }
}
