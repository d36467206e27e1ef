// Find nearest neighbours with a k-d tree. The well-kept libraries of npm search in two dimensions, or find only one.

const LEAF = 12;  // largest number of points of a leaf, which are compared one by one

export class KdTree {
  /** Sort points (4 n) into a tree. */
  constructor(points) {
    this.points = points;
    this.ids = Uint32Array.from({ length: points.length / 4 }, (_, i) => i);
    this.divide(0, this.ids.length, 0);
  }

  /** Divide the ids from start to end into halves along an axis: x and y in turns, because scans are wide and low. */
  divide(start, end, axis) {
    if (end - start <= LEAF) return;
    const middle = (start + end) >> 1, next = 1 - axis;
    this.select(middle, start, end - 1, axis);
    this.divide(start, middle, next);
    this.divide(middle + 1, end, next);
  }

  at(place, axis) {
    return this.points[4 * this.ids[place] + axis];
  }

  /** Move ids so that, along the axis, no point before `middle` is larger and none after it is smaller (quickselect). */
  select(middle, left, right, axis) {
    while (left < right) {
      const pivot = this.at((left + right) >> 1, axis);
      let low = left, high = right;
      while (low <= high) {
        while (this.at(low, axis) < pivot) low++;
        while (this.at(high, axis) > pivot) high--;
        if (low > high) break;
        [this.ids[low], this.ids[high]] = [this.ids[high], this.ids[low]];
        low++;
        high--;
      }
      if (middle <= high) right = high;
      else if (middle >= low) left = low;
      else return;
    }
  }

  /** Return the ids of the m points nearest to a point, the nearest first; the point is one of them. */
  nearest(own, m) {
    const query = this.points.subarray(4 * own, 4 * own + 3), ids = new Uint32Array(m);
    const squares = new Float64Array(m).fill(Infinity);

    const compare = (place) => {
      const id = this.ids[place], [x, y, z] = query, start = 4 * id;
      const square = (this.points[start] - x) ** 2 + (this.points[start + 1] - y) ** 2 + (this.points[start + 2] - z) ** 2;
      if (!(square < squares[m - 1])) return;
      let rank = m - 1;
      for (; rank > 0 && squares[rank - 1] > square; rank--) {
        squares[rank] = squares[rank - 1];
        ids[rank] = ids[rank - 1];
      }
      squares[rank] = square;
      ids[rank] = id;
    };
    const visit = (start, end, axis) => {
      if (end - start <= LEAF) {
        for (let place = start; place < end; place++) compare(place);
        return;
      }
      const middle = (start + end) >> 1, next = 1 - axis, off = query[axis] - this.at(middle, axis);
      const halves = [[start, middle], [middle + 1, end]];
      if (off > 0) halves.reverse();
      visit(...halves[0], next);
      compare(middle);
      if (off * off < squares[m - 1]) visit(...halves[1], next);
    };
    visit(0, this.ids.length, 0);
    return ids;
  }
}

/**
 * Return the n nearest other points (u n) of each point in `own` (u) among points (4 p), the nearest first. If there
 * are fewer than n others, the farthest is repeated. A lone point is its own neighbour.
 */
export function nearestOthers(points, own, n) {
  const tree = new KdTree(points), m = Math.min(n + 1, points.length / 4);
  const neighbours = new Uint32Array(own.length * n);
  own.forEach((point, row) => {
    // A point is not always among its own nearest if many coincide. A lone point has no others: undefined becomes 0, itself.
    const others = tree.nearest(point, m).filter((id) => id !== point);
    for (let rank = 0; rank < n; rank++) neighbours[row * n + rank] = others[Math.min(rank, others.length - 1)];
  });
  return neighbours;
}
