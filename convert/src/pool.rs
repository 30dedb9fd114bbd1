//! Types by name, from which descriptions are put together.

use std::collections::{BTreeMap, HashMap};

use crate::description::{DescriptionError, IndividualType, TypeDescription, at_most};
use crate::limits::{MAX_FIELDS, MAX_TYPES};

/// Types by their full names.
#[derive(Debug, Clone, Default)]
pub struct Pool {
    types: HashMap<String, IndividualType>,
}

/// Why there is no description of a type.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PoolError {
    /// The type itself is not there.
    #[error("{0} is not known")]
    Unknown(String),
    /// A type that it refers to is not there.
    #[error("{missing} is not known, {of} needs it")]
    Missing {
        /// The type that is not there.
        missing: String,
        /// The type that was wanted.
        of: String,
    },
    /// It is not a description.
    #[error(transparent)]
    Description(#[from] DescriptionError),
}

impl Pool {
    /// Adds types; one that is there stays.
    pub(crate) fn add(&mut self, types: impl IntoIterator<Item = IndividualType>) {
        for ty in types {
            self.types.entry(ty.type_name.clone()).or_insert(ty);
        }
    }

    /// Adds the types of another pool; those that are here stay.
    pub(crate) fn merge(&mut self, other: Self) {
        self.add(other.types.into_values());
    }

    /// The type of a full name.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&IndividualType> {
        self.types.get(name)
    }

    /// Full names of all types, in no order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.types.keys().map(String::as_str)
    }

    /// A type and all that it refers to.
    ///
    /// # Errors
    /// If the type or one of those is not here.
    pub fn describe(&self, name: &str) -> Result<TypeDescription, PoolError> {
        Self::collect(name, |name| self.get(name).cloned())
    }

    /// As [`Pool::describe`], of types that `find` returns; each is asked for once.
    pub(crate) fn collect(
        name: &str,
        mut find: impl FnMut(&str) -> Option<IndividualType>,
    ) -> Result<TypeDescription, PoolError> {
        let root = find(name).ok_or_else(|| PoolError::Unknown(name.to_owned()))?;
        let mut found = BTreeMap::new();
        let mut wanted = nested_names(&root);
        let mut fields = root.fields.len();
        while let Some(next) = wanted.pop().filter(|_| found.len() < MAX_TYPES) {
            if next == name || found.contains_key(&next) {
                continue;
            }
            let ty = find(&next)
                .ok_or_else(|| PoolError::Missing { missing: next.clone(), of: name.to_owned() })?;
            fields += ty.fields.len();
            at_most("fields", fields, MAX_FIELDS)?;
            wanted.extend(nested_names(&ty));
            found.insert(next, ty);
        }
        let description = TypeDescription {
            type_description: root,
            referenced_type_descriptions: found.into_values().collect(),
        };
        description.check()?;
        Ok(description)
    }
}

fn nested_names(ty: &IndividualType) -> Vec<String> {
    let names = ty.fields.iter().map(|field| &field.ty.nested_type_name);
    names.filter(|name| !name.is_empty()).cloned().collect()
}
