#!/usr/bin/env bash
# Make the built-in weights again, from streets to OUT/run/weights.safetensors; started again, it goes on.
#
# benchmarks/shipped_weights.sh hdl64e|hdl32e OUT
set -euo pipefail
sensor=$1 out=$2
case $sensor in
    hdl64e)
        recipe=simulated-compact
        # Views of about half as many cells: twice as many scans in the same time.
        small=(--model.range_view.width 1024 --model.polar_view.radial 240 --model.polar_view.angular 180)
        epochs=(20 14) last_epochs=(4 3) # of rv and bev, on small views and on those of the recipe
        ;;
    hdl32e)
        recipe=simulated-hdl32e-compact
        small=(--model.polar_view.radial 240 --model.polar_view.angular 180)
        epochs=(30 18) last_epochs=(4 3)
        ;;
    *) echo "expected hdl64e or hdl32e, found $sensor" >&2 && exit 2 ;;
esac
data=(--data "simulated-$sensor:$out/streets")

# Both networks, one on each core.
networks() { # folder, epochs of rv, epochs of bev, options
    local folder=$1 rv=$2 bev=$3
    shift 3
    OMP_NUM_THREADS=1 amvnet train $recipe "${data[@]}" --out "$folder" --stage rv --resume \
        --training.rv.epochs "$rv" "$@" > "$folder-rv.log" 2>&1 &
    OMP_NUM_THREADS=1 amvnet train $recipe "${data[@]}" --out "$folder" --stage bev --resume \
        --training.bev.epochs "$bev" "$@" > "$folder-bev.log" 2>&1 &
    wait %1
    wait %2
}

export OMP_WAIT_POLICY=passive # two trainings share the cores
trap 'kill $(jobs -p) 2>/dev/null || true' EXIT
mkdir -p "$out"
networks "$out/small" "${epochs[@]}" "${small[@]}"
networks "$out/run" "${last_epochs[@]}" --init "$out/small/weights.safetensors" \
    --training.rv.lr 0.0005 --training.bev.lr 0.0005

# The head learns on streets that the networks have not seen, under stronger changes of the sensor and from
# disturbed scores: on streets like their own the networks are too sure, and the head would rely on them.
amvnet train $recipe "${data[@]}" --out "$out/run" --stage head --resume \
    --train-sequences "$(seq -s, 800000 800059)" --training.head.views 4 --training.head.disturb 0.3 \
    --training.augment.tilt 4 --training.augment.height 0.4 --training.augment.drop 0.5 \
    --training.augment.intensity 0.5 --training.augment.laser_drop 0.3 > "$out/head.log" 2>&1
