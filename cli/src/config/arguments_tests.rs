//! What the command line takes, and what it says to what it does not take.

use super::*;
use crate::args::tests::config;

#[test]
fn every_command_of_the_contract_is_taken() {
    for line in [
        "get nodes",
        "get node robot-1 -o wide",
        "get node/robot-1 --revision 4 --clean -o yaml",
        "get inst -l site=lab --layer edge --limit 5 -o name",
        "get services -w",
        "get svc slam --reveal -o json",
        "describe svc slam",
        "apply -f a.yaml -f dir -f - --dry-run",
        "apply -f a.yaml --prune site=lab --prune-confirm 30 --wait 30s",
        "diff -f a.yaml",
        "diff node robot-1 --from 4 --to 9",
        "patch node robot-1 -p {}",
        "patch node/robot-1 -p - --force",
        "edit layer edge",
        "delete node robot-1 --cascade --yes",
        "delete -f a.yaml -y",
        "history instance slam/0 --limit 3 --full",
        "rollback node robot-1 --to 4",
        "revert 412 --force",
        "effective slam --instance 0 --node robot-1 --explain",
        "effective slam/0",
        "effective --layer edge",
        "effective slam/0 --reveal",
        "topology",
        "digest edge -o json",
        "trim --before 400 --yes",
        "watch",
        "watch node robot-1 --since 0",
        "watch instances --service slam -l a=b --bookmarks",
        "rollout start -f r.yaml",
        "rollout status",
        "rollout status slower",
        "rollout promote slower",
        "rollout abort slower --reason noisy",
        "export",
        "export --layer edge --rollouts",
        "workers --server http://127.0.0.1:1 --token-file t --ca-file c --context lab",
        "workers --client-cert c --client-key k",
        "get nodes --client-cert c",
        "audit --kind node --outcome denied --since 24h --limit 10",
        "token create --subject ops --role operator --role viewer --expires 7d",
        "token create --subject w --role worker --layer edge --key-file k --alg EdDSA --key-id k1 \
         --issuer i --audience a",
        "token list",
        "token revoke 0197",
        "token inspect",
        "token inspect -",
        "token keygen --alg HS256 --out jwt.key",
        "context add lab --server https://lab.example",
        "context add lab --server https://lab.example --client-cert c --client-key k",
        "context use lab",
        "context list",
        "context remove lab",
    ] {
        config(line).unwrap_or_else(|error| panic!("{line}: {error}"));
    }
}

#[test]
fn what_makes_no_sense_is_refused_with_exit_code_2() {
    for line in [
        "get",
        "get zebras",
        "apply",
        "apply -f a --prune-confirm 3",
        "apply -f a --dry-run --wait 3s",
        "apply -f a --wait soon",
        "diff",
        "diff node robot-1",
        "diff -f a node robot-1",
        "delete",
        "delete node a -f b",
        "patch node a",
        "rollback node a",
        "revert",
        "revert 0",
        "effective",
        "effective slam --node a --layer b",
        "effective --instance 0 --node a",
        "effective Slam",
        "watch --since -1",
        "rollout",
        "rollout promote",
        "token create --subject s",
        "token create --subject s --role root",
        "token create --subject s --role viewer --alg HS256",
        "token create --subject s --role viewer --key-file k",
        "token create --subject s --role viewer --token abc",
        "get nodes --token abc",
        "token keygen --alg none --out f",
        "context add lab --server lab.example",
        "context add lab --server https://lab.example --client-key k",
        "get nodes --client-key k",
        "digest",
        "digest Edge",
        "trim",
        "trim --before 0",
        "context add a/b --server https://lab.example",
        "audit --outcome maybe",
    ] {
        let error = config(line).unwrap_err();
        assert_eq!(error.exit_code(), 2, "{line}: {error}");
    }
}

#[tokio::test]
async fn formats_that_a_command_does_not_have_are_refused() {
    let command = config("workers").unwrap();
    let error = run(command, Output::Name).await.unwrap_err();
    assert!(matches!(error, CliError::Usage(_)), "{error}");
}
