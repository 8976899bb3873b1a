//! Ethernet frames that carry the NetworkMessages (OPC 10000-14, 7.3.3).

use std::fmt;
use std::str::FromStr;

/// A group of Ethernet, or another host, and how frames reach it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EthernetGroup {
    /// Name of the network interface.
    pub interface: String,
    /// Address that frames are sent to.
    pub address: MacAddress,
    /// VLAN of the frames, 1 to 4094; `None`: the frames are in no VLAN.
    pub vlan: Option<u16>,
    /// Priority of sent frames (PCP), 0 to 7; `None`: 0, and without a VLAN no tag.
    pub priority: Option<u8>,
}

/// A MAC address of a host, or of a group that IPv4 multicast uses too.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MacAddress([u8; 6]);

/// A MAC address, and the VLAN and priority of its URL.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct EthernetUrl {
    pub(crate) address: MacAddress,
    pub(crate) vlan: Option<u16>,
    pub(crate) priority: Option<u8>,
}

/// The reason why a text is not the address of a host or group.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum EthernetUrlFault {
    /// The text is not a MAC address.
    Form,
    /// The group is not one that IPv4 multicast uses too, or the address is a broadcast or zero.
    Unusable,
    /// The VLAN is not 1 to 4094.
    Vlan,
    /// The priority is not 0 to 7.
    Priority,
}

impl EthernetGroup {
    /// The VLANs of IEEE 802.1Q.
    pub const VLANS: std::ops::RangeInclusive<u16> = 1..=4094;
    /// The priorities of IEEE 802.1Q.
    pub const PRIORITIES: std::ops::RangeInclusive<u16> = 0..=7;
    /// 01-00-5E-40-00-28, the address of the default group of UDP, 239.192.0.40.
    pub const ADDRESS: MacAddress = MacAddress([0x01, 0x00, 0x5E, 0x40, 0x00, 0x28]);
}

impl MacAddress {
    /// Returns the bytes.
    #[must_use]
    pub const fn octets(self) -> [u8; 6] {
        self.0
    }

    /// Returns whether frames can be sent to the address. A group is joined by its IPv4 group, so
    /// other groups are not possible.
    fn is_usable(self) -> bool {
        match self.0 {
            [0x01, 0x00, 0x5E, high, ..] => high < 0x80,
            [first, ..] => first & 1 == 0 && self.0 != [0; 6],
        }
    }
}

impl EthernetUrl {
    /// Reads a MAC address, or `opc.eth://<MAC address>[:<VID>[.<PCP>]]`.
    pub(crate) fn parse(text: &str) -> Result<Self, EthernetUrlFault> {
        let (host, tag) = match text.strip_prefix("opc.eth://") {
            None => (text, None),
            Some(rest) => match rest.split_once(':') {
                Some((host, tag)) if host.contains('-') => (host, Some(tag)),
                Some(_) | None => (rest, None),
            },
        };
        let address: MacAddress = host.parse().map_err(|()| EthernetUrlFault::Form)?;
        if !address.is_usable() {
            return Err(EthernetUrlFault::Unusable);
        }
        let (vlan, priority) = match tag.map(|tag| tag.split_once('.').unwrap_or((tag, ""))) {
            None => (None, None),
            Some((vlan, "")) => (Some(vlan), None),
            Some((vlan, priority)) => (Some(vlan), Some(priority)),
        };
        let number = |text: &str, range: std::ops::RangeInclusive<u16>| {
            let is_number = text.bytes().all(|byte| byte.is_ascii_digit());
            let number = text.parse().ok().filter(|_| is_number);
            number.filter(|number| range.contains(number))
        };
        let vlan = vlan
            .map(|text| number(text, EthernetGroup::VLANS).ok_or(EthernetUrlFault::Vlan))
            .transpose()?;
        let priority = priority
            .map(|text| number(text, EthernetGroup::PRIORITIES).ok_or(EthernetUrlFault::Priority))
            .transpose()?;
        Ok(Self {
            address,
            vlan,
            priority: priority.and_then(|priority| u8::try_from(priority).ok()),
        })
    }
}

impl FromStr for MacAddress {
    type Err = ();

    /// Reads six bytes in hexadecimal, separated by `-` or `:`.
    fn from_str(text: &str) -> Result<Self, ()> {
        let separator = if text.contains('-') { '-' } else { ':' };
        let mut octets = [0; 6];
        let mut parts = text.split(separator);
        for octet in &mut octets {
            let part = parts.next().ok_or(())?;
            let is_hex = part.len() == 2 && part.bytes().all(|byte| byte.is_ascii_hexdigit());
            *octet = u8::from_str_radix(part, 16)
                .ok()
                .filter(|_| is_hex)
                .ok_or(())?;
        }
        match parts.next() {
            None => Ok(Self(octets)),
            Some(_) => Err(()),
        }
    }
}

impl fmt::Display for MacAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [first, rest @ ..] = self.0;
        write!(f, "{first:02X}")?;
        rest.iter().try_for_each(|octet| write!(f, "-{octet:02X}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn url(text: &str) -> Result<(String, Option<u16>, Option<u8>), EthernetUrlFault> {
        let EthernetUrl {
            address,
            vlan,
            priority,
        } = EthernetUrl::parse(text)?;
        Ok((address.to_string(), vlan, priority))
    }

    #[test]
    fn an_address_is_a_mac_address_or_a_url_with_vlan_and_priority() {
        let group = "01-00-5E-7F-00-01";
        for (text, vlan, priority) in [
            (group, None, None),
            ("01:00:5e:7f:00:01", None, None),
            ("opc.eth://01-00-5E-7F-00-01", None, None),
            ("opc.eth://01:00:5E:7F:00:01", None, None),
            ("opc.eth://01-00-5e-7f-00-01:5", Some(5), None),
            ("opc.eth://01-00-5E-7F-00-01:4094.7", Some(4094), Some(7)),
        ] {
            assert_eq!(url(text), Ok((group.to_owned(), vlan, priority)), "{text}");
        }
        let host = url("02-00-00-00-00-0a").unwrap();
        assert_eq!(host.0, "02-00-00-00-00-0A");
        assert_eq!(EthernetGroup::ADDRESS.to_string(), "01-00-5E-40-00-28");
    }

    #[test]
    fn other_texts_and_addresses_are_refused_with_the_reason() {
        use EthernetUrlFault::{Form, Priority, Unusable, Vlan};
        for (text, fault) in [
            ("", Form),
            ("eth0", Form),
            ("01-00-5E-7F-00", Form),
            ("01-00-5E-7F-00-01-02", Form),
            ("01-00-5E-7F-00-1", Form),
            ("+1-00-5E-7F-00-01", Form),
            ("01-00:5E-7F-00-01", Form),
            ("01-00-5E-7F-00-01:5", Form),
            ("opc.udp://239.192.0.40:4840", Form),
            ("FF-FF-FF-FF-FF-FF", Unusable),
            ("00-00-00-00-00-00", Unusable),
            ("01-00-5E-80-00-01", Unusable),
            ("01-1B-19-00-00-00", Unusable),
            ("opc.eth://01-00-5E-7F-00-01:0", Vlan),
            ("opc.eth://01-00-5E-7F-00-01:4095", Vlan),
            ("opc.eth://01-00-5E-7F-00-01:", Vlan),
            ("opc.eth://01-00-5E-7F-00-01:5.8", Priority),
        ] {
            assert_eq!(url(text), Err(fault), "{text}");
        }
    }
}
