#!/usr/bin/env bash
# Make the built-in weights again, from streets to OUT/run/weights.safetensors; started again, it goes on.
#
# benchmarks/shipped_weights.sh hdl64e|hdl32e OUT
#
# docs/log/training.md says where the training of the shipped ones differed.
set -euo pipefail
sensor=$1 out=$2
# Views of fewer cells than the recipe's: more scans in the same time.
small=(--model.polar_view.radial 240 --model.polar_view.angular 180)
case $sensor in
    hdl64e) recipe=simulated-compact small+=(--model.range_view.width 1536) epochs=(20 14) ;; # of rv and bev
    hdl32e) recipe=simulated-hdl32e-compact epochs=(30 18) ;;
    *) echo "expected hdl64e or hdl32e, found $sensor" >&2 && exit 2 ;;
esac
train=(amvnet train $recipe --data "simulated-$sensor:$out/streets" --out "$out/run" --resume "${small[@]}"
    --training.rv.epochs "${epochs[0]}" --training.bev.epochs "${epochs[1]}" --training.rv.region_loss lovasz
    --training.rv.ema 0.999 --training.bev.ema 0.999)

# Both networks, one on each core.
export OMP_WAIT_POLICY=passive # two trainings share the cores
trap 'kill $(jobs -p) 2>/dev/null || true' EXIT
mkdir -p "$out"
OMP_NUM_THREADS=1 "${train[@]}" --stage rv > "$out/rv.log" 2>&1 &
OMP_NUM_THREADS=1 "${train[@]}" --stage bev > "$out/bev.log" 2>&1 &
wait %1
wait %2

# The head learns on streets that the networks have not seen, under stronger changes of the sensor and from
# disturbed scores: on streets like their own the networks are too sure, and the head would rely on them.
"${train[@]}" --stage head \
    --train-sequences "$(seq -s, 800000 800239)" --training.head.views 1 --training.head.points 600000 \
    --training.head.epochs 10 --training.head.disturb 0.3 \
    --training.augment.tilt 4 --training.augment.height 0.4 --training.augment.drop 0.5 \
    --training.augment.intensity 0.5 --training.augment.laser_drop 0.3 > "$out/head.log" 2>&1
