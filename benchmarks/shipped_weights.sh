#!/usr/bin/env bash
# Makes the shipped weights again, from streets to OUT/run/weights.safetensors; started again, it goes on.
#
# benchmarks/shipped_weights.sh hdl64e|hdl32e OUT
set -euo pipefail
sensor=$1 out=$2
case $sensor in
    hdl64e) recipe=simulated-compact data=semantickitti:$out/streets names=%02g streets=140 ;;
    hdl32e) recipe=simulated-hdl32e-compact data=nuscenes:$out/streets names=simulated-%04g streets=84 ;;
    *) echo "expected hdl64e or hdl32e, found $sensor" >&2 && exit 2 ;;
esac
# The head learns on streets that the networks have not seen, as their scores on their own are too sure.
numbers() { seq -s, -f "$names" "$1" $(($1 + $2 - 1)); } # first, how many
networks=$(numbers 0 $streets) validation=$(numbers $streets 6) head=$(numbers $((streets + 6)) 40)

train() { # stage, sequences
    amvnet train $recipe --data "$data" --out "$out/run" --stage "$1" --resume \
        --train-sequences "$2" --val-sequences "$validation" > "$out/$1.log" 2>&1
}
amvnet simulate "$out/streets" --sensor "$sensor" --sequences $((streets + 46)) --scans 6 --seed 11
export OMP_NUM_THREADS=1
trap 'kill $(jobs -p) 2>/dev/null || true' EXIT
train rv "$networks" &
train bev "$networks" &
wait %1
wait %2
OMP_NUM_THREADS=2 train head "$head"
