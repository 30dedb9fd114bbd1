//! Who may do what, by role alone. What of it a token sees is the business of its `layer`.

use std::fmt;

use crate::{Claims, Role};

/// What an operation asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Right {
    /// Documents, effective configuration, history, differences, watch, topology, workers.
    Read,
    /// Documents, apply, rollback, roll-outs.
    Write,
    /// Secrets as text, audit, tokens, trim.
    Admin,
    /// The stream of a worker.
    Sync,
}

impl fmt::Display for Right {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Read => "read",
            Self::Write => "write",
            Self::Admin => "administer",
            Self::Sync => "sync",
        })
    }
}

/// The table of the contract.
const RIGHTS: &[(Role, &[Right])] = &[
    (Role::Viewer, &[Right::Read]),
    (Role::Operator, &[Right::Read, Right::Write]),
    (Role::Admin, &[Right::Read, Right::Write, Right::Admin]),
    (Role::Worker, &[Right::Read, Right::Sync]),
];

/// Whether the roles of a token give a right; several add up.
///
/// # Errors
/// Why not, for log and audit alone. One unknown role refuses everything: what it was meant to
/// allow or to forbid is not known here.
pub fn allowed(claims: &Claims, right: Right) -> Result<(), String> {
    let mut granted = false;
    for text in &claims.roles {
        let role: Role = text.parse().map_err(|error| format!("role {error}"))?;
        granted |= RIGHTS.iter().any(|(of, rights)| *of == role && rights.contains(&right));
    }
    if granted {
        Ok(())
    } else {
        Err(format!("roles {:?} do not give the right to {right}", claims.roles))
    }
}

/// Whether a token is bound to no layer: what concerns the whole system (audit, tokens, trim) is
/// outside every layer's view.
///
/// # Errors
/// Which layer it is bound to, for log and audit alone.
pub fn unbound(claims: &Claims) -> Result<(), String> {
    match &claims.layer {
        None => Ok(()),
        Some(layer) => {
            Err(format!("the token is bound to layer {layer}; this concerns the whole system"))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn claims(roles: &[&str]) -> Claims {
        Claims {
            subject: "ops".to_owned(),
            roles: roles.iter().map(|role| (*role).to_owned()).collect(),
            layer: None,
            expires_s: None,
            token_id: None,
        }
    }

    #[test]
    fn the_table_is_that_of_the_contract() {
        let all = [Right::Read, Right::Write, Right::Admin, Right::Sync];
        for (role, expected) in [
            ("viewer", [true, false, false, false]),
            ("operator", [true, true, false, false]),
            ("admin", [true, true, true, false]),
            ("worker", [true, false, false, true]),
        ] {
            let found = all.map(|right| allowed(&claims(&[role]), right).is_ok());
            assert_eq!(found, expected, "{role}");
        }
        for role in Role::ALL {
            assert!(RIGHTS.iter().any(|(of, _)| of == role), "{role:?} is in the table");
        }
    }

    #[test]
    fn roles_add_up_and_an_unknown_one_refuses_everything() {
        assert!(allowed(&claims(&["viewer", "worker"]), Right::Sync).is_ok());
        assert!(allowed(&claims(&[]), Right::Read).is_err());
        for roles in [&["admin", "root"][..], &["root", "admin"], &["Admin"], &[""]] {
            assert!(allowed(&claims(roles), Right::Read).is_err(), "{roles:?}");
        }
        assert!(unbound(&claims(&["admin"])).is_ok());
        let bound = Claims { layer: Some("edge".parse().unwrap()), ..claims(&["admin"]) };
        assert!(unbound(&bound).unwrap_err().contains("edge"));
    }
}
