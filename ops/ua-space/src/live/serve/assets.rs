//! The meshes and textures of robots, which viewers ask for by the URIs in a model.

use std::path::{Component, Path, PathBuf};

use bridge_node::RosEnvironment;
use type_files::{FileError, read_bounded};

/// The ROS packages of this host with their meshes.
#[derive(Debug, Clone, Default)]
pub(super) struct Assets {
    environment: RosEnvironment,
}

/// A request of a viewer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::live) struct AssetRequest {
    pub(super) id: u32,
    pub(super) uri: String,
}

impl Assets {
    pub(super) const fn new(environment: RosEnvironment) -> Self {
        Self { environment }
    }

    /// Returns whether no ROS package is known.
    pub(super) const fn is_empty(&self) -> bool {
        self.environment.is_empty()
    }

    /// Reads the file of a request. Returns the binary message of the response.
    pub(super) fn response(&self, request: &AssetRequest) -> Vec<u8> {
        let read = self.read(&request.uri);
        let why = read.as_ref().err().map(AssetFault::to_string);
        let why = why.unwrap_or_default();
        let (status, data) = match &read {
            Ok(data) => (FOUND, data.as_slice()),
            Err(_) => (FAILED, [].as_slice()),
        };
        let length = u32::try_from(why.len()).unwrap_or_default();
        let mut message = Vec::with_capacity(data.len() + why.len() + 10);
        message.push(ASSET_RESPONSE);
        message.extend(request.id.to_le_bytes());
        message.push(status);
        message.extend(length.to_le_bytes());
        message.extend(why.as_bytes());
        message.extend(data);
        message
    }

    fn read(&self, uri: &str) -> Result<Vec<u8>, AssetFault> {
        let fault = |reason| AssetFault {
            uri: uri.to_owned(),
            reason,
        };
        let file = self.file(uri).map_err(fault)?;
        // A pipe would wait for its writer.
        if !file.is_file() {
            return Err(fault(NoAsset::NoFile));
        }
        read_bounded(&file, MOST_BYTES).map_err(|error| fault(NoAsset::Read(error)))
    }

    /// Returns the file of a URI `package://NAME/PATH`. Every viewer may ask, so only meshes and
    /// textures below their package are read.
    fn file(&self, uri: &str) -> Result<PathBuf, NoAsset> {
        let known = uri.strip_prefix("package://");
        let Some((package, path)) = known.and_then(|rest| rest.split_once('/')) else {
            return Err(NoAsset::Scheme);
        };
        let path = Path::new(path);
        let is_below = path
            .components()
            .all(|part| matches!(part, Component::Normal(_)));
        let ending = path.extension().and_then(|ending| ending.to_str());
        let ending = ending.unwrap_or_default().to_ascii_lowercase();
        if !is_below || !ENDINGS.contains(&ending.as_str()) {
            return Err(NoAsset::Kind);
        }
        let folder = self.environment.package(package);
        let folder = folder.ok_or_else(|| NoAsset::NoPackage(package.to_owned()))?;
        Ok(folder.join(path))
    }
}

/// An asset that is not served.
#[derive(Debug, thiserror::Error)]
#[error("{uri}: {reason}")]
struct AssetFault {
    uri: String,
    reason: NoAsset,
}

/// The reason why an asset is not served.
#[derive(Debug, thiserror::Error)]
enum NoAsset {
    #[error("only package://PACKAGE/FILE is served")]
    Scheme,
    #[error("only meshes and textures are served")]
    Kind,
    #[error("the package {0} is not in ROS_PACKAGE_PATH or AMENT_PREFIX_PATH of ua-space")]
    NoPackage(String),
    #[error("the package has no such file")]
    NoFile,
    #[error(transparent)]
    Read(FileError),
}

/// The opcode of the response, and its states.
const ASSET_RESPONSE: u8 = 4;
const FOUND: u8 = 0;
const FAILED: u8 = 1;
/// The endings of meshes, their materials and textures.
const ENDINGS: [&str; 14] = [
    "stl", "dae", "obj", "mtl", "glb", "gltf", "ply", "png", "jpg", "jpeg", "tga", "tif", "tiff",
    "webp",
];
/// Maximum size of a file.
const MOST_BYTES: u64 = 64 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_meshes_below_their_package_are_served() {
        let root = std::env::temp_dir().join(format!("ua-space-assets-{}", std::process::id()));
        let package = root.join("share/arm_description");
        std::fs::create_dir_all(package.join("meshes")).unwrap();
        std::fs::write(package.join("meshes/link.STL"), "solid").unwrap();
        std::fs::write(package.join("secret.txt"), "no").unwrap();
        std::fs::write(root.join("share/other.stl"), "no").unwrap();
        let assets = Assets::new(RosEnvironment {
            ros1: Vec::new(),
            ros2: vec![root.clone()],
        });
        let response = |uri: &str| {
            let uri = uri.to_owned();
            assets.response(&AssetRequest { id: 7, uri })
        };
        let found = response("package://arm_description/meshes/link.STL");
        assert_eq!(
            found,
            [&[4, 7, 0, 0, 0, 0, 0, 0, 0, 0][..], b"solid"].concat()
        );
        for refused in [
            "package://arm_description/secret.txt",
            "package://arm_description/../other.stl",
            "package://arm_description/meshes/none.stl",
            "package://../share/other.stl",
            "package://unknown/meshes/link.STL",
            "package://arm_description//etc/x.stl",
            "file:///etc/passwd",
            "",
        ] {
            let message = response(refused);
            assert_eq!(message[..6], [4, 7, 0, 0, 0, 1], "{refused}");
            let length = usize::from(message[6]);
            assert_eq!(message.len(), 10 + length, "{refused}");
        }
        std::fs::remove_dir_all(root).unwrap();
    }
}
