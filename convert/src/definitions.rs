//! Finds the definition of a type: built in, in folders, or added at run time.

use std::collections::HashMap;
use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;

use crate::built_in::{Distro, built_in};
use crate::description::{DescriptionError, TypeDescription, at_most};
use crate::folders::{Folders, Warning};
use crate::hash::TypeHash;
use crate::limits::{MAX_ADDED, MAX_ADDED_BYTES};
use crate::pool::Pool;

/// Source of a definition, in the order of the search.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Source {
    /// Part of this program.
    BuiltIn,
    /// A folder of the node file's `interfaces`.
    Interfaces,
    /// A ROS 2 node answered `get_type_description`.
    Node,
    /// Another flow sent it over the link.
    Flow,
}

impl Source {
    /// Its word in the admin API.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::BuiltIn => "built_in",
            Self::Interfaces => "interfaces",
            Self::Node => "node",
            Self::Flow => "flow",
        }
    }
}

impl fmt::Display for Source {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(self.as_str())
    }
}

/// A definition that was found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Definition {
    /// Its source.
    pub source: Source,
    /// The type and all that it refers to.
    pub description: Arc<TypeDescription>,
    /// The hash of it.
    pub hash: TypeHash,
}

impl Definition {
    fn new(source: Source, description: TypeDescription) -> Self {
        Self { source, hash: description.hash(), description: Arc::new(description) }
    }
}

/// All definitions that a program has.
#[derive(Debug, Clone)]
pub struct Definitions {
    built_in: Arc<Pool>,
    folders: Folders,
    added: HashMap<String, Vec<Definition>>,
    count: usize,
    bytes: usize,
}

impl Definitions {
    /// The built-in types of a release, and folders in the order in which they are searched. A
    /// folder that is not there is a warning.
    #[must_use]
    pub fn new(distro: Distro, folders: Vec<PathBuf>) -> (Self, Vec<Warning>) {
        let (folders, warnings) = Folders::new(folders);
        let built_in = Arc::new(built_in(distro));
        (Self { built_in, folders, added: HashMap::new(), count: 0, bytes: 0 }, warnings)
    }

    /// Other folders and another release, with the definitions that were added.
    #[must_use]
    pub fn reloaded(self, distro: Distro, folders: Vec<PathBuf>) -> (Self, Vec<Warning>) {
        let (new, warnings) = Self::new(distro, folders);
        (Self { built_in: new.built_in, folders: new.folders, ..self }, warnings)
    }

    /// Keeps a definition of a node or flow. Of one hash there is one: the first stays.
    ///
    /// # Errors
    /// For a description that is none, and above [`MAX_ADDED`] descriptions or [`MAX_ADDED_BYTES`].
    pub fn add(
        &mut self,
        source: Source,
        description: TypeDescription,
    ) -> Result<(), DescriptionError> {
        let new = Definition::new(source, description.checked()?);
        let name = &new.description.type_description.type_name;
        let same = |known: &Definition| (known.source, known.hash) == (new.source, new.hash);
        if self.added.get(name).is_some_and(|of_name| of_name.iter().any(same)) {
            return Ok(());
        }
        at_most("descriptions", self.count + 1, MAX_ADDED)?;
        let bytes = self.bytes + new.description.bytes();
        at_most("bytes of descriptions", bytes, MAX_ADDED_BYTES)?;
        self.bytes = bytes;
        self.count += 1;
        let of_name = self.added.entry(name.clone()).or_default();
        let place = of_name.partition_point(|known| known.source <= new.source);
        of_name.insert(place, new);
        Ok(())
    }

    /// The first definition of the name that has the hash; without a hash the first of the name.
    ///
    /// Reads files of the folders if the type is not built in: call it where that may block. Faults
    /// of those files are added to `warnings`.
    #[must_use]
    pub fn find(
        &self,
        name: &str,
        hash: Option<TypeHash>,
        warnings: &mut Vec<Warning>,
    ) -> Option<Definition> {
        let fits = |found: &Definition| hash.is_none_or(|hash| hash == found.hash);
        let built_in = self.built_in.describe(name).ok();
        if let Some(found) =
            built_in.map(|each| Definition::new(Source::BuiltIn, each)).filter(fits)
        {
            return Some(found);
        }
        let in_folders = self.folders.describe(name, &self.built_in, warnings).into_iter();
        let in_folders =
            in_folders.map(|each| Definition::new(Source::Interfaces, each)).find(fits);
        in_folders.or_else(|| self.added.get(name)?.iter().find(|found| fits(found)).cloned())
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::parse_joined;

    const HEADER: &str = "std_msgs/msg/Header";

    fn of_text(name: &str, text: &str) -> TypeDescription {
        parse_joined(name, text, None).expect("a definition")
    }

    #[test]
    fn the_first_source_with_the_hash_wins() {
        let home = tempfile::tempdir().expect("a folder");
        let folder = home.path().join("std_msgs/msg");
        fs::create_dir_all(&folder).expect("a folder");
        fs::write(folder.join("Header.msg"), "string frame_id\n").expect("a file");
        let (mut all, warnings) = Definitions::new(Distro::Jazzy, vec![home.path().into()]);
        assert!(warnings.is_empty());
        let of_node = of_text(HEADER, "uint32 seq\n");
        let of_flow = of_text(HEADER, "uint64 seq\n");
        all.add(Source::Flow, of_flow.clone()).expect("room");
        all.add(Source::Flow, of_node.clone()).expect("room");
        all.add(Source::Node, of_node.clone()).expect("room");
        let source = |hash| all.find(HEADER, hash, &mut Vec::new()).map(|found| found.source);
        assert_eq!(source(None), Some(Source::BuiltIn));
        let in_folder = of_text(HEADER, "string frame_id\n").hash();
        assert_eq!(source(Some(in_folder)), Some(Source::Interfaces));
        assert_eq!(source(Some(of_node.hash())), Some(Source::Node));
        assert_eq!(source(Some(of_flow.hash())), Some(Source::Flow));
        let unknown = of_text("a/msg/B", "int8 x\n").hash();
        assert_eq!(source(Some(unknown)), None);
    }

    #[test]
    fn folders_that_are_missing_are_warnings() {
        let (_, warnings) = Definitions::new(Distro::Humble, vec!["/no/such/folder".into()]);
        assert_eq!(warnings[0].to_string(), "/no/such/folder: is not a folder");
    }

    #[test]
    fn what_was_added_has_a_limit_and_stays_at_a_reload() {
        let (mut all, _) = Definitions::new(Distro::Jazzy, Vec::new());
        for index in 0..MAX_ADDED {
            all.add(Source::Node, of_text(&format!("a/msg/B{index}"), "int8 x\n")).expect("room");
        }
        all.add(Source::Node, of_text("a/msg/B0", "int8 x\n")).expect("it is there");
        let error = all.add(Source::Node, of_text("a/msg/C", "int8 x\n")).expect_err("full");
        assert_eq!(error.to_string(), "has 4097 descriptions, at most 4096 are allowed");
        let large = " ".repeat(1024 * 1024 - 100);
        let (mut small, _) = Definitions::new(Distro::Jazzy, Vec::new());
        let error = (0..100).find_map(|index| {
            let mut description = of_text(&format!("a/msg/B{index}"), "string x\n");
            description.type_description.fields[0].default_value.clone_from(&large);
            small.add(Source::Node, description).err()
        });
        let text = error.expect("full").to_string();
        assert!(text.ends_with("bytes of descriptions, at most 67108864 are allowed"), "{text}");
        let (all, _) = all.reloaded(Distro::Humble, Vec::new());
        let found = all.find("a/msg/B7", None, &mut Vec::new()).expect("it was added");
        assert_eq!((found.source, found.source.as_str()), (Source::Node, "node"));
    }
}
