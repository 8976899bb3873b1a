//! Messages with a large array of bytes: images and point clouds.

use crate::TextStamp;

/// A message type with an array of bytes, and the bytes around the array. The array ends with a
/// [`TextStamp`] and a zero.
#[derive(Debug)]
pub struct ArrayShape {
    /// The ROS type, such as `sensor_msgs/Image`.
    pub message_type: &'static str,
    ros1_head: &'static [u8],
    cdr_head: &'static [u8],
    tail: &'static [u8],
}

impl ArrayShape {
    /// `sensor_msgs/Image`: header, height, width, encoding, `is_bigendian`, step, data.
    pub const IMAGE: Self = Self {
        message_type: "sensor_msgs/Image",
        ros1_head:
            b"\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\x01\0\0\0\x01\0\0\0\x05\0\0\0mono8\0\x01\0\0\0",
        cdr_head:
            b"\0\0\0\0\0\0\0\0\x01\0\0\0\0\0\0\0\x01\0\0\0\x01\0\0\0\x06\0\0\0mono8\0\0\0\x01\0\0\0",
        tail: b"",
    };
    /// `sensor_msgs/PointCloud2`: header, height, width, no fields, `is_bigendian`, `point_step`,
    /// `row_step`, data, `is_dense`.
    pub const POINT_CLOUD: Self = Self {
        message_type: "sensor_msgs/PointCloud2",
        ros1_head: b"\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\x01\0\0\0\x01\0\0\0\0\0\0\0\0\x01\0\0\0\x01\0\0\0",
        cdr_head: b"\0\0\0\0\0\0\0\0\x01\0\0\0\0\0\0\0\x01\0\0\0\x01\0\0\0\0\0\0\0\0\0\0\0\x01\0\0\0\x01\0\0\0",
        tail: b"\x01",
    };

    /// Returns a frame of ROS 1 with an array of `size` bytes and a zero.
    ///
    /// # Panics
    /// Panics if the frame is longer than 4 GiB.
    #[must_use]
    pub fn frame(&self, size: usize) -> Vec<u8> {
        let array = self.array_at();
        let length = array + size + 1 + self.tail.len();
        let mut frame = u32::try_from(length - 4).unwrap().to_le_bytes().to_vec();
        frame.extend_from_slice(self.ros1_head);
        frame.extend_from_slice(&u32::try_from(size + 1).unwrap().to_le_bytes());
        frame.resize(array + size, b'.');
        frame.push(0);
        frame.extend_from_slice(self.tail);
        frame
    }

    /// Stamps the array of a frame with the current time.
    pub fn stamp(&self, frame: &mut [u8], number: u64) {
        let array = self.array_at();
        let end = frame.len().saturating_sub(self.behind());
        if let Some(text) = frame.get_mut(array..end) {
            TextStamp::renew(text, number);
        }
    }

    /// Returns the stamp of a message of ROS 1.
    #[must_use]
    pub fn stamp_of(&self, message: &[u8]) -> Option<TextStamp> {
        let end = message.len().checked_sub(self.behind())?;
        TextStamp::of(message.get(..end)?)
    }

    /// Returns the arguments for the commands `pace` and `meter` of the Fast DDS peer.
    #[must_use]
    pub fn arguments(&self) -> Vec<String> {
        let hex =
            |bytes: &[u8]| -> String { bytes.iter().map(|byte| format!("{byte:02x}")).collect() };
        let mut arguments = vec!["--type".to_owned(), self.message_type.to_owned()];
        arguments.extend(["--head".to_owned(), hex(self.cdr_head)]);
        if !self.tail.is_empty() {
            arguments.extend(["--tail".to_owned(), hex(self.tail)]);
        }
        arguments
    }

    /// Returns the offset of the first byte of the array: behind the lengths of frame and array.
    const fn array_at(&self) -> usize {
        4 + self.ros1_head.len() + 4
    }

    /// Returns the number of bytes behind the stamp.
    const fn behind(&self) -> usize {
        1 + self.tail.len()
    }
}
