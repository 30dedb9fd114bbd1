//! Asking the user at the terminal before something is deleted.

use std::io::{BufRead, IsTerminal as _, Write};

use crate::exit::CliError;

/// Refuses where nobody can be asked and no `--yes` was given.
///
/// # Errors
/// [`CliError::Usage`].
pub(super) fn must_be_possible(yes: bool) -> Result<(), CliError> {
    if yes || std::io::stdin().is_terminal() {
        Ok(())
    } else {
        Err(CliError::Usage("nobody can be asked without a terminal: give --yes".to_owned()))
    }
}

/// Asks at the terminal; only `y` and `yes` are a yes.
///
/// # Errors
/// [`CliError::Failed`] for a terminal that cannot be read or written.
pub(super) fn confirmed(question: &str) -> Result<bool, CliError> {
    confirmed_by(question, &mut std::io::stdin().lock(), &mut std::io::stderr())
}

fn confirmed_by(
    question: &str,
    input: &mut dyn BufRead,
    output: &mut dyn Write,
) -> Result<bool, CliError> {
    let failed = |error: std::io::Error| CliError::Failed(format!("the terminal: {error}"));
    write!(output, "{question} [y/N] ").and_then(|()| output.flush()).map_err(failed)?;
    let mut answer = String::new();
    input.read_line(&mut answer).map_err(failed)?;
    Ok(matches!(answer.trim().to_ascii_lowercase().as_str(), "y" | "yes"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_yes_is_a_yes() {
        for (answer, yes) in
            [("y\n", true), (" YES \n", true), ("\n", false), ("", false), ("yep\n", false)]
        {
            let mut shown = Vec::new();
            let agreed =
                confirmed_by("Delete node/a?", &mut answer.as_bytes(), &mut shown).unwrap();
            assert_eq!(agreed, yes, "{answer:?}");
            assert_eq!(shown, b"Delete node/a? [y/N] ");
        }
        assert!(must_be_possible(true).is_ok());
    }
}
