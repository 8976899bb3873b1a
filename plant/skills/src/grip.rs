//! Grip points: where and how a gripper holds a part.

use std::fmt;
use std::str::FromStr;

use crate::frame::Frame;

/// The way in which a gripper holds a part.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GripType {
    /// Two fingers close from both sides, along the x axis of the grip point.
    Parallel,
    /// A cup holds a flat surface.
    Vacuum,
    /// Several fingers close around the part.
    MultiFinger,
}

impl GripType {
    /// All types, by the values of `GripPointType`.
    pub const ALL: [Self; 3] = [Self::Parallel, Self::Vacuum, Self::MultiFinger];

    /// Returns the value of `GripPointType`.
    #[must_use]
    pub fn number(self) -> i32 {
        match self {
            Self::Parallel => 0,
            Self::Vacuum => 1,
            Self::MultiFinger => 2,
        }
    }

    /// Returns the type of a value of `GripPointType`.
    #[must_use]
    pub fn of_number(number: i64) -> Option<Self> {
        Self::ALL
            .into_iter()
            .find(|of| i64::from(of.number()) == number)
    }

    /// Returns the name in YAML.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Parallel => "parallel",
            Self::Vacuum => "vacuum",
            Self::MultiFinger => "multi_finger",
        }
    }
}

impl fmt::Display for GripType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The grip point of a grasp skill.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GripPoint {
    /// The pose of the grip point in the frame of the tool plate. Its z axis points towards the
    /// part.
    pub offset: [f64; 6],
    /// The way of holding, if the gripper states it.
    pub grip_type: Option<GripType>,
    /// The smallest and the largest width that fits between the fingers, m.
    pub opening: Option<(f64, f64)>,
}

/// The shape of a part around the origin of its frame, which is its centre. The z axis of the part
/// points up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PartShape {
    /// The lengths along x, y and z, m.
    Box([f64; 3]),
    /// An upright cylinder, m.
    Cylinder {
        /// Its diameter.
        diameter: f64,
        /// Its height.
        height: f64,
    },
    /// A sphere with this diameter, m.
    Sphere(f64),
}

/// A text that is not the shape of a part.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("is no shape: `box X Y Z`, `cylinder DIAMETER HEIGHT` or `sphere DIAMETER`, above 0 m")]
pub struct NoShape;

impl fmt::Display for PartShape {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Box([x, y, z]) => write!(f, "box {x} {y} {z}"),
            Self::Cylinder { diameter, height } => write!(f, "cylinder {diameter} {height}"),
            Self::Sphere(diameter) => write!(f, "sphere {diameter}"),
        }
    }
}

impl FromStr for PartShape {
    type Err = NoShape;

    fn from_str(text: &str) -> Result<Self, NoShape> {
        let mut words = text.split_ascii_whitespace();
        let kind = words.next().ok_or(NoShape)?;
        let lengths = words.map(|word| word.parse().map_err(|_| NoShape));
        let lengths: Vec<f64> = lengths.collect::<Result<_, _>>()?;
        if !lengths
            .iter()
            .all(|length| length.is_finite() && *length > 0.0)
        {
            return Err(NoShape);
        }
        match (kind, &lengths[..]) {
            ("box", &[x, y, z]) => Ok(Self::Box([x, y, z])),
            ("cylinder", &[diameter, height]) => Ok(Self::Cylinder { diameter, height }),
            ("sphere", &[diameter]) => Ok(Self::Sphere(diameter)),
            _ => Err(NoShape),
        }
    }
}

/// The reason why a gripper cannot hold a part.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum GripError {
    /// The part is wider than the gripper opens, or narrower than it closes.
    #[error("the part is {width} m wide, and the gripper holds from {least} to {most} m")]
    Width {
        /// The width of the part, m.
        width: f64,
        /// The smallest width that the gripper holds, m.
        least: f64,
        /// The largest width that the gripper holds, m.
        most: f64,
    },
    /// Vacuum needs a flat top.
    #[error("the part has no flat top for vacuum")]
    NoFlatTop,
}

impl GripPoint {
    /// Returns the pose of the grip point in the frame of the part, for a grasp from above: vacuum
    /// holds the top of the part, fingers hold its sides at half of its height.
    ///
    /// # Errors
    /// [`GripError`].
    pub fn on(&self, shape: Option<&PartShape>) -> Result<Frame, GripError> {
        let (height, turn) = match (self.grip_type, shape) {
            (Some(GripType::Vacuum), Some(shape)) => (shape.flat_top()? / 2.0, 0.0),
            (Some(GripType::Parallel), Some(shape)) => (0.0, self.turn(shape)?),
            (Some(GripType::MultiFinger), Some(shape)) => {
                let (x, y) = shape.widths();
                self.fits(x.max(y))?;
                (0.0, 0.0)
            }
            (None, _) | (Some(_), None) => (0.0, 0.0),
        };
        let above = Frame::of_pose([0.0, 0.0, height, 0.0, 0.0, turn]);
        Ok(above.then(&from_above()))
    }

    /// Returns the rotation about the z axis of the part with which the part fits between two
    /// fingers, rad.
    fn turn(&self, shape: &PartShape) -> Result<f64, GripError> {
        let (x, y) = shape.widths();
        match (self.fits(x), self.fits(y)) {
            (Ok(()), _) => Ok(0.0),
            (Err(_), Ok(())) => Ok(std::f64::consts::FRAC_PI_2),
            (Err(why), Err(_)) => Err(why),
        }
    }

    fn fits(&self, width: f64) -> Result<(), GripError> {
        match self.opening {
            Some((least, most)) if !(least..=most).contains(&width) => {
                Err(GripError::Width { width, least, most })
            }
            Some(_) | None => Ok(()),
        }
    }
}

impl PartShape {
    /// Returns the widths along x and y, m.
    fn widths(&self) -> (f64, f64) {
        match *self {
            Self::Box([x, y, _]) => (x, y),
            Self::Cylinder { diameter, .. } | Self::Sphere(diameter) => (diameter, diameter),
        }
    }

    /// Returns the height of a part with a flat top, m.
    fn flat_top(&self) -> Result<f64, GripError> {
        match *self {
            Self::Box([_, _, height]) | Self::Cylinder { height, .. } => Ok(height),
            Self::Sphere(_) => Err(GripError::NoFlatTop),
        }
    }
}

/// Returns the orientation of a tool that points down, in the frame of a part.
fn from_above() -> Frame {
    Frame::of_pose([0.0, 0.0, 0.0, std::f64::consts::PI, 0.0, 0.0])
}

/// The poses of the flange for a part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Hold {
    /// The flange in the frame of the part; `None` if the pose of the part is the pose of the
    /// flange.
    flange: Option<Frame>,
}

impl Hold {
    /// Returns how the flange holds a part by a grip point. `plate` is the tool plate in the frame
    /// of the flange.
    ///
    /// # Errors
    /// As [`GripPoint::on`].
    pub(crate) fn new(
        grip: Option<&GripPoint>,
        plate: &Frame,
        shape: Option<&PartShape>,
    ) -> Result<Self, GripError> {
        let Some(grip) = grip else {
            return Ok(Self { flange: None });
        };
        let tip = plate.then(&Frame::of_pose(grip.offset));
        let flange = grip.on(shape)?.then(&tip.inverse());
        Ok(Self {
            flange: Some(flange),
        })
    }

    /// Returns the pose of the flange that brings the grip point to a part at this pose.
    pub(crate) fn at(&self, part: [f64; 6]) -> [f64; 6] {
        match &self.flange {
            Some(flange) => Frame::of_pose(part).then(flange).pose(),
            None => part,
        }
    }

    /// Returns the pose of the flange at this distance before the part, along the z axis of the
    /// tool; above the part if the gripper states no grip point.
    pub(crate) fn before(&self, part: [f64; 6], distance: f64) -> [f64; 6] {
        let [x, y, z, a, b, c] = part;
        if self.flange.is_none() {
            // The z axis of a flange usually points down, towards the part.
            return [x, y, z + distance, a, b, c];
        }
        let above = Frame::of_pose(part).then(&Frame::at([0.0, 0.0, distance]));
        let [x, y, z] = above.position();
        self.at([x, y, z, a, b, c])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FINGERS: GripPoint = GripPoint {
        offset: [0.0, 0.0, 0.2028, 0.0, 0.0, 0.0],
        grip_type: Some(GripType::Parallel),
        opening: Some((0.0, 0.085)),
    };
    const CUP: GripPoint = GripPoint {
        offset: [0.0, 0.0, 0.1868, 0.0, 0.0, 0.0],
        grip_type: Some(GripType::Vacuum),
        opening: None,
    };
    const PART: PartShape = PartShape::Box([0.12, 0.04, 0.06]);

    #[test]
    fn vacuum_holds_the_top_and_fingers_hold_the_narrow_sides_further_down() {
        let tip = |grip: &GripPoint| grip.on(Some(&PART)).unwrap();
        let near = |at: [f64; 3], z: f64| {
            let [x, y, found] = at;
            x.abs() < 1e-12 && y.abs() < 1e-12 && (found - z).abs() < 1e-12
        };
        assert!(near(tip(&CUP).position(), 0.03));
        assert!(near(tip(&FINGERS).position(), 0.0));
        // The fingers close along x of the grip point, which is y of the part.
        let along = tip(&FINGERS).then(&Frame::at([1.0, 0.0, 0.0])).position();
        assert!((along[1].abs() - 1.0).abs() < 1e-12, "{along:?}");
        let down = tip(&CUP).then(&Frame::at([0.0, 0.0, 1.0])).position();
        assert!((down[2] + 0.97).abs() < 1e-12, "{down:?}");
    }

    #[test]
    fn a_part_that_does_not_fit_is_refused_with_its_size() {
        let wide = PartShape::Box([0.12, 0.1, 0.06]);
        let why = FINGERS.on(Some(&wide)).unwrap_err();
        assert_eq!(
            why.to_string(),
            "the part is 0.12 m wide, and the gripper holds from 0 to 0.085 m"
        );
        let ball = PartShape::Sphere(0.03);
        let why = CUP.on(Some(&ball)).unwrap_err();
        assert_eq!(why, GripError::NoFlatTop);
        assert!(FINGERS.on(Some(&ball)).is_ok() && CUP.on(None).is_ok());
    }

    #[test]
    fn the_approach_without_a_grip_point_is_above_a_flange_that_points_down() {
        let hold = Hold::new(None, &Frame::IDENTITY, None).unwrap();
        let down = [0.4, 0.2, 0.1, std::f64::consts::PI, 0.0, 0.0];
        let before = hold.before(down, 0.05);
        assert!((before[2] - 0.15).abs() < 1e-12, "{before:?}");
        assert_eq!(before[3..], down[3..]);
    }

    #[test]
    fn the_flange_of_two_lengths_brings_the_grip_point_to_the_part_upright_and_tilted() {
        let plates = [Frame::IDENTITY, Frame::at([0.0, 0.0, 0.047])];
        let poses = [
            [0.4, 0.2, 0.1, 0.0, 0.0, 0.0],
            [0.4, -0.2, 0.15, 0.3, -0.4, 1.1],
        ];
        for (grip, plate, part) in [FINGERS, CUP]
            .iter()
            .flat_map(|grip| plates.iter().map(move |plate| (grip, plate)))
            .flat_map(|(grip, plate)| poses.map(|pose| (grip, plate, pose)))
        {
            let hold = Hold::new(Some(grip), plate, None).unwrap();
            let tip = plate.then(&Frame::of_pose(grip.offset));
            let contact = Frame::of_pose(hold.at(part)).then(&tip);
            assert!(contact.distance(&Frame::of_pose(part)) < 1e-9);
            let before = Frame::of_pose(hold.before(part, 0.05)).then(&tip);
            // The way to the part is along z of the tool.
            let ahead = before.then(&Frame::at([0.0, 0.0, 0.05]));
            assert!(ahead.distance(&contact) < 1e-9);
        }
    }

    #[test]
    fn without_a_grip_point_the_flange_is_brought_to_the_given_pose() {
        let hold = Hold::new(None, &Frame::IDENTITY, None).unwrap();
        let pose = [0.4, 0.2, 0.1, 0.0, 0.0, 0.0];
        assert_eq!(hold.at(pose), pose);
        let [.., z, a, b, c] = hold.before(pose, 0.05);
        assert!((z - 0.15).abs() < 1e-12 && [a, b, c] == [0.0; 3]);
    }
}
